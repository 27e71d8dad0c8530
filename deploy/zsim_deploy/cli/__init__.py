"""The command line, one file per family of commands. Imports all other packages."""
