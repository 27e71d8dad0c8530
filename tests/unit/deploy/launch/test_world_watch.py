"""Signs of life of the world, as its launcher gets them."""

from refused import has_terms

from zsim_deploy.launch.world_watch import SILENT_S, WorldWatch


def test_a_stopped_world_is_named_once_within_two_seconds_and_once_when_it_is_back():
    watch = WorldWatch()
    assert watch.change(100.0, 7) is None  # it may still compile
    watch.received(100.0)
    assert watch.change(100.0 + 0.9 * SILENT_S, 7) is None
    assert has_terms(watch.change(102.0, 7) or "", "world", "2.0 s", "stopped")
    assert watch.change(110.0, 7) is None
    watch.received(110.0)
    assert has_terms(watch.change(110.1, 7) or "", "world", "back")
    assert watch.change(110.2, 7) is None


def test_a_world_that_ends_is_not_taken_for_the_one_that_it_waits_for():
    watch = WorldWatch()
    watch.received(100.0)
    watch.clock({"state": "running", "waiting_for": [{"name": "estimator.d1"}]})
    watch.clock({"state": "stopped", "waiting_for": [{"name": "recorder"}]})
    text = watch.change(102.0, 7) or ""
    assert has_terms(text, "world", "ended", "recorder")
    assert "kill" not in text
