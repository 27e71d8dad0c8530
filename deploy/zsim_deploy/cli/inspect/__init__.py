"""What looks at a running federation and pokes it: keys, echo, hz, pub, ask."""
