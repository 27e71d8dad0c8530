"""Puts the commit into what is built: an sdist and a wheel have no git to ask."""

import sys
import tempfile
from pathlib import Path
from typing import Any

from hatchling.builders.hooks.plugin.interface import BuildHookInterface

sys.path.insert(0, str(Path(__file__).parent))
from zsim import COMMIT_FILE, commit


class CommitHook(BuildHookInterface):
    """Adds zsim/commit.txt; an editable install reads git's files itself."""

    def initialize(self, version: str, build_data: dict[str, Any]) -> None:
        """Write the file before the build."""
        self._folder = tempfile.TemporaryDirectory()
        found = commit()
        if found and version != "editable":
            path = Path(self._folder.name) / COMMIT_FILE
            path.write_text(f"{found}\n")
            build_data["force_include"][str(path)] = f"zsim/{COMMIT_FILE}"

    def finalize(self, version: str, build_data: dict[str, Any], artifact_path: str) -> None:
        """Remove the file after the build."""
        self._folder.cleanup()
