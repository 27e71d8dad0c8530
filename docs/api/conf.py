"""Sphinx's configuration for the reference of zsim in Python, which is made of the docstrings.

    make docs    # into build/api

Its names are those of `zsim_api.__all__`, shown as `zsim.NAME`. A new one needs nothing here: it is on the page of its
module, or on the first one. A name without a docstring is an error.
"""

import inspect
import re
from collections.abc import Iterator
from types import FunctionType, ModuleType
from typing import Any

from docutils.nodes import Node
from sphinx.application import Sphinx
from sphinx.pycode import ModuleAnalyzer
from sphinx.util import logging
from sphinx.util.docutils import SphinxDirective

import zsim
import zsim_api

PAGES = {  # last parts of modules by page
    "flights": ("flight", "simulation", "recorded", "sweeping", "scenarios", "errors"),
    "commands": ("commands", "assignment"),
    "agents": ("agent", "control_law", "cluster_space", "drone_estimator", "fmu_agent"),
    "testing": ("federation", "programs", "pytest_plugin"),
    "environments": ("environments", "policy"),
}
LOGGER = logging.getLogger(__name__)
FIRST = next(iter(PAGES))
BESIDE = {
    "Federation": ("Moment",),
    "Simulation": ("Truth", "Estimates", "Sensors", "Samples"),
}  # of its module, where it names them
INHERITING = ("Federation",)  # whose methods of their base classes are documented with them

project, author, version = "zsim", "the authors of zsim", zsim.RELEASE
html_title = f"zsim {zsim.RELEASE} from Python"
html_theme = "furo"
html_show_copyright = False
extensions = ["sphinx.ext.autodoc", "sphinx.ext.napoleon"]
autodoc_member_order = "bysource"
autodoc_default_options = {"members": True, "undoc-members": True}
autodoc_typehints_format = "short"
python_use_unqualified_type_names = True
python_maximum_signature_line_length = 100
napoleon_numpy_docstring = False
napoleon_use_ivar = True
default_role = "code"


class Public(SphinxDirective):
    """Puts the names of a page there: `.. public:: commands`."""

    required_arguments = 1

    def run(self) -> list[Node]:
        lines = [line for name in names_of(self.arguments[0]) for line in directive(name)]
        return self.parse_text_to_nodes("\n".join(lines))


def names_of(page: str) -> list[str]:
    page_of = {module: each for each, modules in PAGES.items() for module in modules}
    return [
        name
        for module, names in zsim_api._WHERE.items()
        for name in names
        if page_of.get(module.rpartition(".")[2], FIRST) == page
    ]


def directive(name: str) -> Iterator[str]:
    """Yield the directive for a name, with a warning if it, or a method of it, has no docstring."""
    found = getattr(zsim, name)
    if isinstance(found, FunctionType | type | ModuleType):
        undocumented = [name] if not found.__doc__ else []
        if isinstance(found, type):
            undocumented += [f"{name}.{each}" for each in members(found) if not inspect.getdoc(getattr(found, each))]
        for each in undocumented:
            LOGGER.warning(f"zsim.{each}, of {zsim_api._MODULES[name]}, has no docstring")
        kind = "class" if isinstance(found, type) else "module" if isinstance(found, ModuleType) else "function"
        yield f".. auto{kind}:: zsim.{name}"
        if name in INHERITING:
            yield "   :inherited-members:"
        yield ""
        for other in BESIDE.get(name, ()):
            yield from (f".. autoclass:: {found.__module__}.{other}", "")
        return
    module = zsim_api._MODULES[name]
    text = ModuleAnalyzer.for_module(module).find_attr_docs().get(("", name))
    if not text:
        LOGGER.warning(f"zsim.{name}, of {module}, has no docstring, which is below a value")
    yield from (f".. py:data:: zsim.{name}", "", *(f"   {line}" for line in text or ()), "")


def members(kind: type) -> list[str]:
    own: Any = (FunctionType, property, classmethod, staticmethod)
    return [name for name, each in vars(kind).items() if not name.startswith("_") and isinstance(each, own)]


def show(app: Sphinx, what: str, name: str, found: Any, options: Any, lines: list[str]) -> None:
    """Show indented paragraphs, but for those of sections, as code; give attributes that share a text one each."""
    section, is_code = "", False
    shown: list[str] = []
    for before, line in zip(["", *lines], lines, strict=False):
        if line and not line.startswith(" "):
            section, is_code = line, False
        elif line.startswith("    ") and not before and not is_code and not section.endswith(":"):
            shown += [".. code-block:: python", ""]
            is_code = True
        shared = re.fullmatch(r"    (\w+(?:, \w+)+): (.*)", line) if section == "Attributes:" else None
        shown += [f"    {each}: {shared[2]}" for each in shared[1].split(", ")] if shared else [line]
    lines[:] = shown


def setup(app: Sphinx) -> None:
    app.add_directive("public", Public)
    app.connect("autodoc-process-docstring", show, priority=100)  # before napoleon
