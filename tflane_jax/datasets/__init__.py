"""One file for each source of data, and how a moment of a log becomes an `Example`."""
