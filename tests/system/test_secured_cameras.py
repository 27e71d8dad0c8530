"""Cameras and detectors over TLS: they work with the rights of their role, and are refused without them."""

from collections.abc import Iterator

import forked_commands
import pytest
from federation import ONE, Federation
from forked_commands import USER_FAULT
from refused import has_terms
from secured import Certificates, KeyLog, RawClient, tls_endpoint

from zsim.scenario import scenario_file
from zsim_deploy.certificates import access_control

EYES = ONE.replace("sensors: {preset: paper}", "sensors: {preset: paper, front_camera: {rate_hz: 10}}")
LET_IN = ("camera.drone1", "detector.drone1", "operator.main")
INFO, PICTURES, SEEN = "drone/drone1/camera/front/info", "drone/drone1/camera/front", "drone/drone1/sightings"


@pytest.fixture(scope="module")
def made(tmp_path_factory: pytest.TempPathFactory) -> Certificates:
    return Certificates(tmp_path_factory.mktemp("certs"))


@pytest.fixture(scope="module")
def endpoint(tmp_path_factory: pytest.TempPathFactory, made: Certificates, compiled: None) -> Iterator[str]:
    """The endpoint of a world that admits a camera, a detector and an operator."""
    world = made.identity("world", access_control(scenario_file.from_text(EYES), LET_IN, {}))
    at = tls_endpoint()
    secured = ("--listen", at, "--tls", str(world.tls), "--access", str(world.access))
    with Federation(tmp_path_factory.mktemp("world")) as federation:
        federation.start("world", federation.write(EYES), "--rate", "1", "--duration", "600", *secured)
        yield at


def test_a_camera_and_a_detector_work_with_the_rights_of_their_roles(
    federation: Federation, made: Certificates, endpoint: str
) -> None:
    for command, name in (("camera", "camera.drone1"), ("detect", "detector.drone1")):
        role = federation.start(command, "drone1", "--connect", endpoint, "--tls", str(made.of(name)))
        role.line(f"{name}: in run")
    with RawClient(endpoint, made.of("operator.main")) as operator:
        came = KeyLog()
        for key in (INFO, PICTURES, SEEN):
            operator.subscribe(key, came)
        operator.until_answered(INFO)
        came.until(lambda keys: keys >= {PICTURES, SEEN})


# (command, certificate that it uses, key that this may not read)
OF_ANOTHER_ROLE = (
    ("camera", "detector.drone1", "drone/*/truth"),
    ("detect", "camera.drone1", "drone/drone1/camera/front/info"),
)


@pytest.mark.parametrize(("command", "certificate", "key"), OF_ANOTHER_ROLE)
def test_a_camera_or_detector_with_anothers_certificate_is_refused(
    made: Certificates, endpoint: str, command: str, certificate: str, key: str
) -> None:
    done = forked_commands.run(command, "drone1", "--connect", endpoint, "--tls", str(made.of(certificate)))
    assert done.code == USER_FAULT
    assert has_terms(done.stderr.splitlines()[-1], certificate, "read", key, "zsim certs init")
