"""An inventory and a scenario as files for launchers that people already have: systemd, Docker Compose, Kubernetes.

Every target is a pure function from (InventoryFile, Scenario) to {path inside the output folder: text}; the same input
gives the same text. Imports launch (exit codes, limits of restarts) and inventory.
"""
