"""What every process of a federation shares: time, frames, keys, messages, scenario, session, agent.

Rooms from the ground: errors, math and schema, contract, then record, scenario and transport, which do not import each
other, and runtime; a room imports those below it. Nothing here imports another package of the product.
"""

__version__ = "0.1.0"
CONTRACT = 1
