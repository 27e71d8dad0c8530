"""A run without session and wall clock: who takes part, simulated time, commands, faults, requests, refusals.

Each file uses those below it only; what an object needs of another one is handed to its constructor.

    world                                 one flight
      ├─ command_intake ─ command_queue   commands: checked, queued, applied; commanders
      ├─ fault_injector                   injected faults
      └─ coordinator                      what a flight and a replay have in common
           ├─ run_statistics              figures of the run
           ├─ barrier                     who takes part, who is waited for
           ├─ run_clock                   simulated time and its requests
           └─ run_outbox                messages, events and refusals to be published

Imports fleet and what it stands on.
"""
