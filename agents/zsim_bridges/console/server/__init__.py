"""What a browser connects to: the HTTP server with tokens and roles, its sockets, and viser's server behind it."""
