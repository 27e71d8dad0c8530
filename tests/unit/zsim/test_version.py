"""The version says of which commit the code is: in a checkout, a worktree, a wheel, and an archive made by git."""

import re
import subprocess
import time
import tomllib
from pathlib import Path

import pytest

import zsim
from zsim.runtime.membership import Membership
from zsim.scenario import scenario_file
from zsim_world.run.world import World

ROOT = Path(__file__).parents[3]
WHO = ("-c", "user.name=me", "-c", "user.email=me@localhost", "-c", "init.defaultBranch=main")
OTHER = "0123456789abcdef0123456789abcdef01234567"


def git(folder: Path, *words: str) -> str:
    done = subprocess.run(["git", *WHO, "-C", str(folder), *words], check=True, capture_output=True, text=True)
    return done.stdout.strip()


def head(checkout: Path) -> str:
    return git(checkout, "rev-parse", "HEAD")


@pytest.fixture
def checkout(tmp_path: Path) -> Path:
    (tmp_path / "checkout" / "zsim").mkdir(parents=True)
    git(tmp_path / "checkout", "init", "-q")
    git(tmp_path / "checkout", "commit", "-q", "--allow-empty", "-m", "first")
    return tmp_path / "checkout"


def test_a_checkout_and_a_worktree_have_the_commits_of_their_branches_which_may_be_packed_or_none(checkout: Path):
    first = head(checkout)
    assert zsim.commit(checkout / "zsim") == first
    git(checkout, "commit", "-q", "--allow-empty", "-m", "second")
    assert zsim.commit(checkout / "zsim") == head(checkout) != first
    worktree = checkout.parent / "worktree"
    git(checkout, "worktree", "add", "-q", "-b", "other", str(worktree))
    git(worktree, "commit", "-q", "--allow-empty", "-m", "third")
    assert zsim.commit(worktree / "zsim") == head(worktree) != head(checkout)
    git(checkout, "branch", "n/main")  # ends as the other one does
    git(checkout, "pack-refs", "--all")
    assert not (checkout / ".git" / "refs" / "heads" / "main").exists()
    assert zsim.commit(checkout / "zsim") == head(checkout)
    git(checkout, "checkout", "-q", "--detach")
    assert zsim.commit(checkout / "zsim") == head(checkout)


def test_what_was_built_has_the_commit_of_the_build_and_else_the_release_alone(tmp_path: Path) -> None:
    (tmp_path / zsim.COMMIT_FILE).write_text(f"{OTHER}\n")
    assert zsim.commit(tmp_path) == OTHER
    (tmp_path / zsim.COMMIT_FILE).write_bytes((ROOT / "zsim" / zsim.COMMIT_FILE).read_bytes())
    assert zsim.commit(tmp_path) == ""


def test_an_archive_made_by_git_has_its_commit(checkout: Path) -> None:
    for name in (f"zsim/{zsim.COMMIT_FILE}", ".gitattributes"):
        (checkout / name).write_bytes((ROOT / name).read_bytes())
    git(checkout, "add", ".")
    git(checkout, "commit", "-q", "-m", "with the placeholder")
    git(checkout, "archive", "--output", "../archive.tar", "HEAD")
    (checkout.parent / "archive").mkdir()
    subprocess.run(["tar", "xf", "archive.tar", "-C", "archive"], cwd=checkout.parent, check=True)
    assert zsim.commit(checkout.parent / "archive" / "zsim") == head(checkout)


def test_world_and_participants_state_the_same_version() -> None:
    assert tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]["version"] == zsim.RELEASE
    assert re.fullmatch(rf"{re.escape(zsim.RELEASE)}(\+g[0-9a-f]{{{zsim.DIGITS}}})?", zsim.__version__)
    scenario = scenario_file.load(ROOT / "scenarios" / "step.yaml")
    world = World(scenario, "lockstep", 0.0, time.monotonic_ns)
    assert (
        world.info().version
        == zsim.__version__
        == Membership("estimator.drone1", "here", "run", lambda kind: 0).join().version
    )
