"""The image, and the Compose file that flies Test 1 in it: the rights of the container, and the files that it names.

The schema of the Compose file is validated in tests/system/test_render_valid.py.
"""

import re
from pathlib import Path

import yaml

ROOT = Path(__file__).parents[3]
CONTAINER = ROOT / "deploy/container"
STAGES = re.split(r"^FROM ", (CONTAINER / "Dockerfile").read_text(), flags=re.MULTILINE)[1:]


def test_the_image_has_only_what_was_built_and_runs_without_privileges() -> None:
    built, flown = STAGES
    name = built.splitlines()[0].split()[-1]
    copied = re.findall(r"^COPY (?:--from=(\w+) )?(\S+) \S+$", flown, re.MULTILINE)
    assert {stage for stage, _ in copied} == {name, ""}
    assert all((ROOT / path).is_dir() for stage, path in copied if not stage)
    assert not re.search(r"\bpip\b", flown)
    last = re.findall(r"^(USER|ENTRYPOINT) (.*)$", flown, re.MULTILINE)
    user, group = map(int, dict(last)["USER"].split(":"))  # numeric, because Kubernetes can check only numeric IDs
    assert user > 0
    assert group > 0


def test_test_1_is_flown_with_the_fewest_rights() -> None:
    document = yaml.safe_load((CONTAINER / "compose.yaml").read_text())
    (service,) = document["services"].values()
    assert service["read_only"] is True
    assert service["cap_drop"] == ["ALL"]
    assert service["security_opt"] == ["no-new-privileges:true"]
    assert service["network_mode"] == "none"
    assert not service["user"].startswith(("0", "root"))
    assert not {"privileged", "cap_add", "pid", "ipc", "environment", "env_file", "secrets"} & set(service)
    targets = {volume["target"] for volume in service["volumes"]} | set(service["tmpfs"])
    assert targets == {"/cache", "/runs", "/tmp"}
    command, scenario, _, out = service["command"]
    assert command == "run"
    assert (ROOT / scenario.lstrip("/")).is_file()
    assert out.startswith("/runs/")
    built = (CONTAINER / service["build"]["context"]).resolve()
    assert built == ROOT
    assert (built / service["build"]["dockerfile"]).is_file()
