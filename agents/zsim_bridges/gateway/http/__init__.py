"""The gateway over HTTP: JSON tree, Zenoh's REST tree, OpenAPI, server-sent events."""
