"""What commands print for people, on terminals of any width."""
