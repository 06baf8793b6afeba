"""The commands: their options and what they run (imported lazily by the command line)."""
