"""The command line, and launching processes here and on other hosts."""
