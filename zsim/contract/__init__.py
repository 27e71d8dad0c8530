"""The contract: what travels on which key, how it is encoded, and what makes runs comparable.

    keys              keys and key expressions; TOPICS, the table that the messages' declarations fill
    flight_messages   messages of drones, estimates, formations, cameras and displays
    run_messages      messages about time, events, participants, faults and requests
    messages          `world/info`; messages encoded and decoded by their keys
    framing           many messages in one payload
    encoding          messages written from and read into rows of numbers, by compiled code
    snapshot          the state of an agent as bytes
    fingerprint       what the last bit of a number depends on; the hash of a flight's truth

Imports sensors and schema.
"""
