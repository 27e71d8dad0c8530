"""Connections, commands and files on other hosts over ssh. Imports inventory."""
