"""The command line: click commands and the options, tables and progress that they share."""
