"""The rules of a run, without session or wall clock: participants, time, commands, faults, requests, refusals.

Each module uses only those below it; an object receives its dependencies through its constructor.

    world                                 one flight                playback                one replay
      ├─ commands                         commands: checked, queued, applied; commanders
      ├─ faults                           injected faults
      └─ coordinator                      the part common to flights and replays: participants, requests, time
           ├─ barrier                     participants, and those that the world waits for
           ├─ run_clock                   simulated time, requests that control it, statistics of the run
           └─ outbox                      messages, events and refusals to be published
"""
