"""The folder of a record that is named after its run."""

from pathlib import Path

import pytest
from refused import refused

from zsim.errors import RecordError
from zsim_deploy.roles.roles import record_folder


@pytest.mark.parametrize(
    ("out", "folder"), [("runs/step-{run}", "runs/step-0badcafe"), ("runs/step", "runs/step"), (".", "."), ("{run}/x", "{run}/x")]
)  # fmt: skip
def test_the_id_of_the_run_is_put_into_the_last_name(out: str, folder: str) -> None:
    assert record_folder(Path(out), "0badcafe") == Path(folder)


@pytest.mark.parametrize("run_id", ["../../etc", "", "a/b", "a" * 65, "\x1b[2J", ".."])
def test_an_id_that_leads_elsewhere_is_a_line(run_id: str) -> None:
    with refused(RecordError, "runs/step-{run}", repr(run_id[:40]), "1", "64", "--out"):
        record_folder(Path("runs/step-{run}"), run_id)
    assert record_folder(Path("runs/step"), run_id) == Path("runs/step")
