"""Answers what is asked of the world: last values, a part of its history, requests."""

from dataclasses import dataclass

from zsim.contract import keys, messages
from zsim.contract.run_messages import ControlAnswer, ControlRequest
from zsim.errors import DecodeError
from zsim.scenario import rights
from zsim.transport.session import Query, Session
from zsim_world.run.coordinator import Coordinator
from zsim_world.run.message_history import MessageHistory
from zsim_world.server.journal_entries import Controlled
from zsim_world.server.run_journal import RunJournal


@dataclass(eq=False)
class QueryService:
    """Serves the queries of one world; what a request makes it publish is left in its outbox."""

    link: Session
    world: Coordinator
    history: MessageHistory
    journal: RunJournal  # is written before a request is answered

    def answered_keys(self) -> tuple[str, ...]:
        """Return the expressions on which queries are to be taken."""
        return (*rights.LAST_VALUES, keys.CONTROL, keys.replay("*"), *self.world.refused_queries)

    def serve(self, query: Query) -> None:
        """Answer a query: with last values, a part of the history, or as a request."""
        replaying = keys.thing(query.expression) if keys.matches(keys.replay("*"), query.expression) else None
        if query.expression in self.world.refused_queries:
            self._refuse(query)
        elif query.expression == keys.CONTROL or replaying is not None:
            try:
                answer = self._answer(query.request(), replaying)
            except DecodeError as error:
                answer = ControlAnswer(ok=False, error=str(error))
            self.journal.commit()
            query.answer(answer)
        else:
            for key, payload in self.history.last(query.expression):
                query.reply(key, payload)
            query.end()

    def _refuse(self, query: Query) -> None:
        """Refuse a request on another process's key, unless that process answers it."""
        reason = self.world.refusal_at(query.expression)
        if reason is None:
            query.end()
        else:
            query.answer(ControlAnswer(ok=False, error=reason))

    def _answer(self, request: ControlRequest, process: str | None) -> ControlAnswer:
        """Answer a request on `world/control`, or of a process on its own key, by which access control knows it."""
        if request.op == "replay":
            return self.history.replay(request.args, self._readable_by(process))
        if process is not None:
            return ControlAnswer(ok=False, error=f"op is {request.op[:40]!r}; must be replay")
        answer = self.world.control(request)
        if self.world.ended is None:
            self.journal.note(Controlled(messages.encode(request)))
        return answer

    def _readable_by(self, process: str | None) -> tuple[str, ...]:
        if process is None or not self.link.guarded:
            return ("**",)
        return rights.of(process, self.world.scenario).reads
