"""Zenoh: sessions, their settings, TLS, how a process finds the world, and the messages that pass the hub as batches.

Only `session` imports zenoh. Imports contract.
"""

import os

# Zenoh reads these when it is loaded; reasons in docs/decisions/0002-zenoh-settings.md.
os.environ.setdefault("ZENOH_RUNTIME", "(rx: (worker_threads: 1))")
os.environ.setdefault("RUST_LOG", "error")
