"""The options of each command, one file per group of commands. Nothing slow is imported here."""
