"""Camera and detector processes: the choice of pictures under overload, poses between gates, and invalid pictures."""

from collections.abc import Sequence
from typing import Any

import numpy as np
import pytest
from fake_link import FakeLink
from msgspec.structs import replace
from pictures import HATS
from refused import has_terms
from synthetic_pictures import NO_JPEG, WIDTH_PX, image, info, jpeg

from zsim.contract import keys, messages
from zsim.contract.flight_messages import Sightings, Truth
from zsim.contract.messages import Info, Origin
from zsim.runtime.participant import Participant
from zsim.scenario import scenario_file
from zsim_agents.cameras import camera_process
from zsim_agents.cameras.camera_process import (
    PENDING_MAX,
    PRINTED_MAX,
    CameraProcess,
    DetectorProcess,
    TruthHistory,
    stationary_truth,
)
from zsim_agents.cameras.detector import PIXELS_MAX
from zsim_agents.cameras.renderer import Renderer
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


def truth(gate: int, x: float = 0.0, rotor: float = 100.0) -> Truth:
    """Return the truth of a drone that flies east at 2 m/s with steadily accelerating rotors."""
    at, turning = (x + 2.0 * gate * GATE_NS / 1e9, 0.0, 1.0), (0.0, 0.0, 0.1 * gate)
    return Truth(gate * GATE_NS, gate, at, (2.0, 0.0, 0.0), (1.0, *ZEROS), turning, ZEROS, (rotor + gate,) * 4)


class Drawing:
    """A camera process for all drones whose world advances by some gates while a picture is drawn."""

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
        """Return the number of exposures with a picture for each drone."""
        return [len({m.t_sample_ns for m in self.link.published_on(keys.camera(d, camera))}) for d in DRONES]


@pytest.mark.parametrize("gates_per_picture", [2, 4, 12])
def test_a_slow_camera_process_skips_pictures_of_all_drones_equally(
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


def test_a_gating_camera_draws_the_first_picture_despite_early_answers(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """The answer to a request may overtake messages published before it."""
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


# Poses between two gates

PLACED = scenario_file.resolve(
    {"name": "t", "duration_s": 1, "drones": [{"name": "d2", "position_m": [7, 0, 0], "yaw_deg": 90}]}
)
STANDING = stationary_truth(PLACED.drones[0], 4)


def history(gates: int, span_gates: int = 5) -> TruthHistory:
    kept = TruthHistory(2, GATE_NS, span_gates * GATE_NS)
    for gate in range(gates):
        kept.add(1, truth(gate, 10.0))
        kept.add(0, truth(gate))
    return kept


def test_bodies_are_interpolated_between_two_gates() -> None:
    kept = history(6)
    bodies, last = kept.bodies(4 * GATE_NS + GATE_NS // 4), kept.bodies(5 * GATE_NS)
    assert bodies is not None
    assert bodies.p_WB[:, 0] == pytest.approx([0.17, 10.17])
    assert bodies.w_WB_B[:, 2] == pytest.approx([0.425, 0.425])
    assert bodies.rotors[1] == pytest.approx([104.25] * 4)
    assert last is not None  # at a gate, no other gate is needed
    assert last.p_WB[0, 0] == pytest.approx(0.2)


def test_bodies_too_new_too_old_or_incomplete_are_unavailable() -> None:
    kept = history(30)
    kept.add(0, truth(30))
    assert kept.newest_ns == 29 * GATE_NS
    assert kept.bodies(29 * GATE_NS + 1) is None
    assert kept.bodies(GATE_NS) is None
    assert kept.bodies(26 * GATE_NS) is not None


def test_a_gate_that_stays_incomplete_is_skipped_and_discarded() -> None:
    kept = history(2)
    kept.add(0, truth(2))
    for gate in range(3, 3 + 2 * PENDING_MAX):
        kept.add(0, truth(gate))
    last = 3 + 2 * PENDING_MAX
    for gate in (last, last + 1):
        kept.add(0, truth(gate))
        kept.add(1, truth(gate))
    assert kept.newest_ns == (last + 1) * GATE_NS
    assert kept.bodies(2 * GATE_NS) is None
    assert np.isfinite(kept.bodies(last * GATE_NS + 1).p_WB).all()  # type: ignore[union-attr]


def test_an_external_drone_is_drawn_at_its_extrapolated_pose() -> None:
    """Its driver may skip gates or be absent; the camera does not wait for it."""
    kept = TruthHistory(2, GATE_NS, 50 * GATE_NS, {1: STANDING})
    for gate in range(5):
        kept.add(0, truth(gate))
    assert kept.newest_ns == 4 * GATE_NS
    before = kept.bodies(4 * GATE_NS)
    assert before is not None
    assert before.p_WB[:, 0] == pytest.approx([0.16, 7.0])
    kept.add(1, truth(5, 10.0))
    kept.add(1, replace(truth(5, 30.0), rotor_rad_s=(1.0,) * 6))
    kept.add(1, replace(truth(5, 30.0), orientation_wxyz=(0.0,) * 4))
    kept.add(0, truth(5))
    for gate in range(6, 46):
        kept.add(0, truth(gate))
    for gate, x in ((5, 10.2), (15, 10.6), (30, 11.2), (45, 11.2)):
        bodies = kept.bodies(gate * GATE_NS)
        assert bodies is not None
        assert bodies.p_WB[1, 0] == pytest.approx(x)
    kept = TruthHistory(2, GATE_NS, 5 * GATE_NS, {0: STANDING, 1: STANDING})
    kept.add(1, truth(3, 10.0))
    bodies = kept.bodies(3 * GATE_NS)
    assert bodies is not None
    assert bodies.p_WB[:, 0] == pytest.approx([7.0, 10.12])


INFO = Info(0, 0, 1, "r", "zsim", "lockstep", 0.0, 1, 1, 1, 1, Origin(0.0, 0.0, 0.0), (), (), "", "", "", "")
FRONT, FRONT_INFO = keys.camera("d1", "front"), keys.camera_info("d1", "front")
SIDE, SIDE_INFO = keys.camera("d1", "side"), keys.camera_info("d1", "side")
ABSURD_PX = 16_384  # the longest side that the contract allows


class Detecting:
    """A detector for drone d1 or for other drones, with its reports and published messages."""

    def __init__(self, drones: Sequence[str] = ("d1",)) -> None:
        self.link, self.said = FakeLink(), []
        link: Any = self.link
        self.presence = Participant(link, INFO, "detector.d1")
        self._process = DetectorProcess(link, self.presence, self.said.append, drones, HATS.diameter_m)
        self._process.begin()

    def take(self, *arrived: tuple[str, Any]) -> None:
        """Deliver messages and let the process take one turn."""
        for key, message in arrived:
            self.link.deliver(key, message)
        self._process.turn()

    def sightings(self) -> list[Sightings]:
        return self.link.published_on(keys.detections("d1"))

    def counted(self) -> tuple[int, int, int]:
        """Return the numbers of pictures received, refused and dropped."""
        health = self.presence.health
        return health.received, health.refused, health.dropped


def test_a_picture_is_processed_once_the_camera_info_is_known() -> None:
    detecting = Detecting()
    detecting.take((FRONT, image(1)))
    assert (detecting.sightings(), detecting.counted()) == ([], (0, 0, 1))
    detecting.take((FRONT_INFO, info()), (FRONT, image(10_000_000)))
    (seen,) = detecting.sightings()
    assert (seen.t_sample_ns, seen.source, seen.camera, seen.seen) == (6_000_000, "detector.d1", "front", ())
    assert detecting.counted() == (1, 0, 1)


def of_an_absurd_size() -> bytes:
    """Return a small JPEG whose header claims gigapixels."""
    data = bytearray(jpeg())
    at = data.index(b"\xff\xc0") + 5
    data[at : at + 4] = b"\xff\xff\xff\xff"
    return bytes(data)


NO_PICTURES = {
    "no jpeg": NO_JPEG,
    "nothing": b"",
    "cut": jpeg()[:-200],
    "of another size": jpeg(width=2 * WIDTH_PX),
    "of an absurd size": of_an_absurd_size(),
}


@pytest.mark.parametrize("name", NO_PICTURES)
def test_an_invalid_picture_is_counted_and_the_next_one_processed(name: str) -> None:
    detecting = Detecting()
    detecting.take((FRONT_INFO, info()), (FRONT, image(0, data=NO_PICTURES[name])))
    detecting.take((FRONT, image(10_000_000)))
    assert detecting.counted() == (1, 1, 0)
    assert len(detecting.sightings()) == 1
    assert has_terms(detecting.said[0], "detector.d1", FRONT)


def test_invalid_pictures_are_reported_only_a_few_times() -> None:
    detecting = Detecting()
    for _ in range(50):
        detecting.take((FRONT, image(0, data=NO_JPEG)))
    assert (detecting.counted()[1], len(detecting.said)) == (50, PRINTED_MAX)


@pytest.mark.parametrize(
    ("fields", "terms"),
    [
        ({"width": ABSURD_PX, "height": ABSURD_PX}, (str(ABSURD_PX), str(PIXELS_MAX))),
        ({"K": (0.0,) * 9}, ("0", "> 0")),
        ({"width": 10**9}, ("width", str(10**9))),
    ],
)
def test_an_invalid_camera_info_is_refused_before_memory_is_allocated(
    monkeypatch: pytest.MonkeyPatch, fields: dict[str, Any], terms: tuple[str, ...]
) -> None:
    monkeypatch.setattr(camera_process, "HatDetector", lambda *_: pytest.fail("was made"))
    detecting = Detecting()
    detecting.take((FRONT_INFO, replace(info(), **fields)))
    assert detecting.counted() == (0, 1, 0)
    assert has_terms(detecting.said[0], FRONT_INFO, *terms)
    assert detecting.said[0].count(FRONT_INFO) == 1


def test_only_the_newest_of_many_pictures_is_kept() -> None:
    detecting = Detecting()
    detecting.take((FRONT_INFO, info()), *((FRONT, image(number * 1_000_000)) for number in range(100)))
    assert detecting.counted() == (1, 0, 99)
    assert [seen.t_ns for seen in detecting.sightings()] == [99_000_000]


def test_an_overloaded_detector_processes_equally_many_of_each_camera() -> None:
    """Whenever one picture has been processed, new ones of all cameras have arrived."""
    drones = ["d1", "d2", "d3"]
    detecting = Detecting(drones)

    def all_expose(key: str = "", _: object = None) -> None:
        for drone in drones if not key or key.endswith("/sightings") else ():
            detecting.link.deliver(keys.camera(drone, "front"), image(0))

    detecting.take(*((keys.camera_info(drone, "front"), info()) for drone in drones))
    all_expose()
    detecting.link.on_publish = all_expose
    for _ in range(4):
        detecting.take()
    assert [len(detecting.link.published_on(keys.detections(drone))) for drone in drones] == [4, 4, 4]


def test_pictures_of_an_unknown_camera_are_ignored() -> None:
    detecting = Detecting()
    detecting.take((SIDE_INFO, info()), (SIDE, image(0)), (FRONT_INFO, info()), (FRONT, image(0)))
    assert [seen.camera for seen in detecting.sightings()] == ["front"]
    assert detecting.counted() == (1, 0, 0)
