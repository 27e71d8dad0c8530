"""Zenoh: sessions, settings, TLS, finding the world, and the traffic through the hub.

Only `session` imports zenoh. Imports contract.
"""

import os

# Zenoh reads these when it is loaded; see docs/decisions/0002-zenoh-settings.md for the reasons.
os.environ.setdefault("ZENOH_RUNTIME", "(rx: (worker_threads: 1))")
os.environ.setdefault("RUST_LOG", "error")
