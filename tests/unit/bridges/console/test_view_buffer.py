"""The events as a page shows them: counted, kept apart from a flood, chosen by drone and kind."""

from zsim.contract.run_messages import Event
from zsim_bridges.console.view_buffer import ALL, OWN, ROWS_KEPT, EventLog, chosen_rows

OWN_NAME = "console.1"


def event(kind: str, source: str, subject: str, text: str, t_ns: int = 0) -> Event:
    return Event(t_ns, 0, kind, source, subject, text)


def test_equal_events_are_one_with_a_count():
    log = EventLog(OWN_NAME)
    for t_ns in range(20):
        log.add(event("refused", "mine", "drone1", f"age is {t_ns} ms; must be less", t_ns))
    log.add(event("refused", "mine", "drone2", "age is 4 ms; must be less"))
    assert [(row.event.subject, row.times) for row in log.rows()] == [("drone2", 1), ("drone1", 20)]
    assert log.rows()[1].event.t_ns == 19
    assert len(log.newest) == 21


def test_a_flood_leaves_the_operator_s_own_actions():
    log = EventLog(OWN_NAME)
    log.add(event("accepted", OWN_NAME, "main", "main: takeoff: accepted"))
    for number in range(3 * ROWS_KEPT):
        log.add(event("refused", f"s{number}", "drone1", "no"))
    rows = log.rows()
    assert len(rows) == ROWS_KEPT + 1
    assert [row.event.subject for row in chosen_rows(rows, kind=OWN)] == ["main"]


def test_events_are_chosen_by_drone_and_kind():
    log = EventLog(OWN_NAME)
    log.add(event("death", "world", "estimator.drone1", "died"))
    log.add(event("fault", "world", "drone10", "gps_dropout of drone10 begins"))
    log.add(event("fault", "world", "drone1", "gps_dropout of drone1 begins"))
    rows = log.rows()
    assert [row.event.subject for row in chosen_rows(rows, "drone1")] == ["drone1", "estimator.drone1"]
    assert [row.event.subject for row in chosen_rows(rows, "drone10")] == ["drone10"]
    assert [row.event.kind for row in chosen_rows(rows, ALL, "processes")] == ["death"]
