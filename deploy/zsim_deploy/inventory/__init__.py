"""The inventory: hosts, how to reach them, which process runs where and what it needs. Imports options."""
