"""The rules of a run, without session or wall clock: participants, time, commands, faults, requests, refusals.

Each module uses only those below it; an object receives its dependencies through its constructor.

    inputs                                all inputs of a world or a replay, as entries of the journal
    world                                 one flight                playback                one replay
      ├─ commands                         commands: checked, queued, applied; commanders
      ├─ faults                           injected faults
      └─ coordinator                      the part common to flights and replays: participants, requests, time
           ├─ run_clock                   simulated time, requests that control it, statistics of the run
           ├─ barrier                     participants, and those that the world waits for
           └─ outbox                      messages, events and refusals to be published
"""
