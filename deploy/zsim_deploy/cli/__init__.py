"""The command line, one file per family of commands: options in, one call, one line for a fault. Imports everything."""
