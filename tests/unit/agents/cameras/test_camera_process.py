"""The process of a camera: which pictures it draws when there is no time for all of them."""

from typing import Any

import pytest
from fake_link import FakeLink
from synthetic_pictures import jpeg

from zsim.contract import keys, messages
from zsim.contract.flight_messages import Truth
from zsim.runtime.participant import Participant
from zsim.scenario import scenario_file
from zsim_agents.cameras.camera_process import CameraProcess
from zsim_agents.cameras.rendering.renderer import Renderer
from zsim_world.run.world import World

SCENARIO = scenario_file.from_text("""
name: three
duration_s: 1
sensors: {preset: paper, front_camera: {}, bottom_camera: {}}
drones:
  - {name: d1, position_m: [0, 0, 0]}
  - {name: d2, position_m: [3, 0, 0], sensors: {front_camera: {latency_ms: 0}}}
  - {name: d3, position_m: [6, 0, 0]}
""")
DRONES = [drone.name for drone in SCENARIO.drones]
GATE_NS = 20_000_000
ZEROS = (0.0, 0.0, 0.0)


def truth(gate: int) -> Truth:
    return Truth(gate * GATE_NS, gate, ZEROS, ZEROS, (1.0, *ZEROS), ZEROS, ZEROS, (0.0,) * 4)


class Drawing:
    """A camera process of all drones, whose world goes on by some gates while a picture is drawn."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch, gates_per_picture: int) -> None:
        self.link, self._gate = FakeLink(), 0

        def drawn(*_: object) -> bytes:
            self.fly(gates_per_picture)
            return jpeg()

        monkeypatch.setattr(Renderer, "jpeg", drawn)
        link: Any = self.link
        info = World(SCENARIO, run_id="r").info()
        self.process = CameraProcess(
            link, info, Participant(link, info, "camera.main", slack_ns=GATE_NS), SCENARIO, DRONES
        )
        self.process.begin()

    def fly(self, gates: int) -> None:
        """Let the truth of some gates arrive."""
        for _ in range(gates):
            for drone in DRONES:
                self.link.deliver(keys.truth(drone), truth(self._gate))
            self._gate += 1

    def pictures(self, camera: str) -> list[int]:
        """Return of how many exposures each drone has pictures."""
        return [len({m.t_sample_ns for m in self.link.published_on(keys.camera(d, camera))}) for d in DRONES]


@pytest.mark.parametrize("gates_per_picture", [2, 4, 12])
def test_a_camera_process_that_is_too_slow_leaves_out_pictures_of_all(
    monkeypatch: pytest.MonkeyPatch, gates_per_picture: int
) -> None:
    drawing = Drawing(monkeypatch, gates_per_picture)
    drawing.fly(20)
    for _ in range(60):
        drawing.process.turn()
    for camera in ("front", "bottom"):
        counts = drawing.pictures(camera)
        assert min(counts) > 5
        assert max(counts) <= 2 * min(counts), counts


def test_a_camera_that_gates_draws_the_first_picture_whatever_is_answered_first(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """An answer to what is asked for may overtake what was published before it."""
    drawing = Drawing(monkeypatch, gates_per_picture=0)
    link = drawing.link

    def start(key: str, _: bytes) -> None:
        if key == keys.process("camera.main", "join"):
            for drone in DRONES:
                link.last[keys.truth(drone)] = messages.encode(truth(1))

    link.on_publish = start
    drawing.process.join()
    drawing.fly(6)
    drawing.process.turn()
    assert link.published_on(keys.camera("d1", "front"))[0].t_sample_ns == 0
