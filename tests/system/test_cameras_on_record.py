"""Pictures on record: written beside what passes the world, flown again without them, played back as they were."""

from pathlib import Path

import pytest
from federation import ONE, Federation
from picture_pump import calibration, pumping
from test_replay import Ear, recorded, replay, resume

FRONT, FRONT_INFO = "drone/drone1/camera/front", "drone/drone1/camera/front/info"


@pytest.fixture(scope="module")
def filmed(tmp_path_factory: pytest.TempPathFactory, compiled: None) -> Path:
    """The folder of a run of 4 s beside which a camera of somebody's own publishes."""
    with Federation(tmp_path_factory.mktemp("filmed")) as federation:
        world = federation.world(ONE.replace("duration_s: 10", "duration_s: 4"), "--rate", "1", "--expect", "recorder")
        recorder = federation.role("record", "--out", str(federation.out))
        camera = federation.client()
        camera.subscribe("clock").until(lambda m: m["state"] == "running")
        camera.put(FRONT_INFO, **calibration())
        with pumping(camera, FRONT):
            world.ends(with_code=0)
            recorder.ends(with_code=0)
        assert federation.record().complete
        return federation.out


def test_they_are_on_record_and_the_run_is_flown_again_without_them(filmed: Path, federation: Federation) -> None:
    pictures = recorded(filmed, FRONT)[FRONT]
    assert len(pictures) > 20
    assert len(set(pictures)) == len(pictures)  # none is there twice
    assert len(recorded(filmed, FRONT_INFO)[FRONT_INFO]) == 1
    again = federation.start("rerun", str(filmed))
    again.ends(with_code=0)
    again.line("truth_sha256 is the same")


def test_a_replay_plays_them_byte_by_byte_and_answers_how_the_camera_sees(filmed: Path, federation: Federation) -> None:
    pictures = recorded(filmed, FRONT)[FRONT]
    role = replay(federation, filmed, "--rate", "2", "--paused")
    client = federation.client()
    ear, clock = Ear(client, FRONT), client.subscribe("clock")
    clock.until(lambda m: m["state"] == "paused")
    resume(client)
    clock.until(lambda m: m["t_ns"] >= 3_000_000_000)
    (info,) = client.get("drone/*/camera/*/info").values()
    assert {name: info[name] for name in ("K", "D", "orientation_wxyz")} == {
        name: calibration()[name] for name in ("K", "D", "orientation_wxyz")
    }
    assert FRONT not in client.get("drone/*/sensor/status")
    clock.until(lambda m: m["state"] == "stopped")
    role.ends(with_code=0)
    played = ear.received[FRONT]
    assert len(played) > 1  # a machine with much to do skips some
    assert [payload for payload in pictures if payload in set(played)] == played
