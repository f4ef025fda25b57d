"""What each command takes, one file a group of commands. Nothing slow is imported here."""
