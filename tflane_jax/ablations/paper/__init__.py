"""The tables of the three papers as data: what is trained, what is claimed, what the papers print."""
