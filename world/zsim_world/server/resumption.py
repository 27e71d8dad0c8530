"""A world that goes on where another one died: from a checkpoint, by all that it was handed since."""

from dataclasses import dataclass
from typing import Any

from zsim.contract import keys, messages
from zsim.contract.run_messages import ControlRequest, Join
from zsim.errors import RunError
from zsim.transport.session import ReceivedSample
from zsim_world.run.coordinator import Coordinator
from zsim_world.run.message_history import MessageHistory
from zsim_world.run.world import World
from zsim_world.server.journal_entries import (
    Advanced,
    Controlled,
    Died,
    Entry,
    Expired,
    FalselyJoined,
    FellSilent,
    GivenUp,
    Joined,
    Kept,
    NotShown,
    ReaderClosed,
    Resumed,
    Taken,
)
from zsim_world.server.run_journal import RunJournal
from zsim_world.server.world_inputs import MessageIntake
from zsim_world.server.world_outputs import WorldOutputs


@dataclass(eq=False)
class Resumption:
    """Brings a world that is new to where the journal ends; nothing of it is published again."""

    world: Coordinator
    journal: RunJournal
    history: MessageHistory
    intake: MessageIntake
    outputs: WorldOutputs

    def run(self) -> bool:
        """Do it; return whether there was a journal to go on from.

        Raises:
            RunError: the journal is of another run, or its state does not fit the scenario.
        """
        checkpoint = self.journal.open()
        world = self.world
        if not isinstance(world, World):
            return False
        if checkpoint is None:
            world.keep_truth(self.journal.keep_truth)
            return False
        world.keep_truth(self.journal.keep_truth, self.journal.truth(checkpoint.truth_bytes))
        if checkpoint.state is not None:
            self._restore(world, checkpoint.state)
        self.intake.replaying = True
        for entry in self.journal.entries():
            self._hand(entry)
        self.intake.replaying = False
        self.outputs.gather()
        self.outputs.forget()
        return True

    def _restore(self, world: World, state: dict[str, Any]) -> None:
        try:
            world.restore(state["world"])
            self.history.restore(state["last"])
        except (KeyError, TypeError, ValueError) as error:
            text = f"the checkpoint does not fit this version of zsim ({type(error).__name__}: {error})"
            raise RunError(f"{text}; fly the run again") from error

    def _hand(self, entry: Entry) -> None:
        """Hand the world once more what it was handed, and keep what follows from it."""
        match entry:
            case Taken(wall_ns, key, payload):
                self.intake.take_again(wall_ns, ReceivedSample(key, payload))
                return
            case Advanced(wall_ns, late):
                self.world.statistics.world_misses += late
                self.world.advance(wall_ns)
            case Joined(wall_ns, name, join):
                self.world.handle(keys.process(name, "join"), _join(join), wall_ns)
            case FalselyJoined(name, join, reason):
                self.world.losses.falsely_joined(name, _join(join), reason)
            case NotShown(wall_ns, name, reason):
                self.world.losses.not_shown(name, reason, wall_ns)
            case Died(wall_ns, name):
                self.world.losses.died(name, wall_ns)
            case Expired(name):
                self.world.losses.expired(name)
            case Controlled(request):
                self.world.control(messages.decode_as(ControlRequest, request, keys.CONTROL))
            case FellSilent(name, since_wall_ns):
                self.world.losses.silence_changed(name, since_wall_ns)
            case ReaderClosed(text, data):
                self.world.losses.reader_closed(text, data)
            case GivenUp(name):
                self.world.give_up_outputs(name)
            case Resumed(wall_ns, all_died):
                self.world.await_return(wall_ns, all_died)
            case Kept(key, payload):
                self.history.add(key, payload, self.world.now_ns)
                self.world.outbox.next_seq(key)
            case _:
                raise AssertionError(entry)
        self.outputs.gather()


def _join(payload: bytes) -> Join:
    return messages.decode_as(Join, payload, "join")
