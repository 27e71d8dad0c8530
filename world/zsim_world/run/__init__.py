"""The rules of a run, without session and wall clock: participants, time, commands, faults, requests, refusals.

Each file uses those below it only; what an object needs of another one is passed to its constructor.

    world                                 one flight                playback                one replay
      ├─ commands                         commands: checked, queued, applied; commanders
      ├─ faults                           injected faults
      └─ coordinator                      what a flight and a replay have in common: participants, requests, time
           ├─ barrier                     participants, and whom the world waits for
           ├─ run_clock                   simulated time, its requests, figures of the run
           └─ outbox                      messages, events and refusals to be published
"""
