"""The configuration of one aircraft: values in three levels beside the common ones, each under an identifier.

An application, a user (`profile`) and a session has values of its own for the entries of its category. Whoever writes
an identifier of `custom` makes it the current one; an unknown one begins with the defaults.

Source: AR.Drone Developer Guide SDK 2.0, chapter 8.
"""

import math
import re
from collections.abc import Mapping

from zsim_bridges.ardrone.aircraft.configuration_entries import ENTRIES, LIMITS, TEXT_MAX, Category, ConfigurationEntry
from zsim_bridges.ardrone.wire.configuration_text import CustomList

DEFAULT_ID = "00000000"  # of each level (Developer Guide 8.1)
KEPT_MAX = 64  # configurations of a level, chosen: identifiers cost their sender nothing
_LEVELS: dict[str, Category] = {"application": "application", "profile": "user", "session": "session"}
"""Categories by the name that `custom` has for them."""
_ID = re.compile(r"[0-9A-Za-z]{1,32}")


class ConfigurationError(ValueError):
    """An entry is not taken; the text says why."""


class Configuration:
    """The values of all entries.

    Args:
        highest: the greatest value of an entry that the aircraft flies by, where it is below the SDK's.
        fixed: values of entries that are the aircraft's own.
    """

    def __init__(self, highest: Mapping[str, float], fixed: Mapping[str, str]) -> None:
        self._highest = highest
        self._common: dict[str, str] = dict(fixed)
        self._kept: dict[Category, dict[str, dict[str, str]]] = {level: {DEFAULT_ID: {}} for level in _LEVELS.values()}
        self._described: dict[Category, dict[str, str]] = {level: {DEFAULT_ID: "default"} for level in _LEVELS.values()}
        self._current: dict[Category, str] = dict.fromkeys(_LEVELS.values(), DEFAULT_ID)

    def text(self, key: str) -> str:
        """Return the value of an entry as it is written."""
        entry = ENTRIES[key]
        value = self._values(entry).get(key, entry.default)
        high = self._highest.get(key)
        return value if high is None or float(value) <= high else f"{high:g}"

    def number(self, key: str) -> float:
        """Return the value of an entry that is a number."""
        return float(self.text(key))

    def flag(self, key: str) -> bool:
        """Return the value of an entry that is a flag."""
        return self.text(key) == "TRUE"

    def all(self) -> dict[str, str]:
        """Return all entries, those of `custom` last."""
        custom: dict[str, str] = {}
        for name, level in _LEVELS.items():
            current = self._current[level]
            custom[f"custom:{name}_id"] = current
            custom[f"custom:{name}_desc"] = self._described[level][current]
        return {**{key: self.text(key) for key in ENTRIES}, **custom}

    def custom_list(self) -> CustomList:
        """Return which configurations there are."""
        return CustomList(*(dict(self._described[level]) for level in _LEVELS.values()))

    def is_current(self, session: str, user: str, application: str) -> bool:
        """Tell whether these are the identifiers in force."""
        current = self._current
        return (session, user, application) == (current["session"], current["user"], current["application"])

    def set(self, key: str, value: str) -> None:
        """Take a value.

        Raises:
            ConfigurationError: there is no such entry, it cannot be written, or the value is none that it can have.
        """
        key = key.lower()
        if key.startswith("custom:"):
            self._set_custom(key.removeprefix("custom:"), value)
            return
        entry = ENTRIES.get(key)
        if entry is None:
            raise ConfigurationError(f"{key[:60]!r} is no entry of the configuration")
        self._values(entry)[key] = _checked(key, entry, value)
        self._follow_sets(key)

    def _values(self, entry: ConfigurationEntry) -> dict[str, str]:
        if entry.category == "common":
            return self._common
        return self._kept[entry.category][self._current[entry.category]]

    def _follow_sets(self, key: str) -> None:
        """Keep the limits in force and those of the set that they are from the same."""
        place = "outdoor" if self.flag("control:outdoor") else "indoor"
        section, _, name = key.partition(":")
        if key == "control:outdoor":
            for limit in LIMITS:
                self._copy(f"control:{place}_{limit}", f"control:{limit}")
        elif section == "control" and name in LIMITS:
            self._copy(key, f"control:{place}_{name}")
        elif section == "control" and name.removeprefix(f"{place}_") in LIMITS:
            self._copy(key, f"control:{name.removeprefix(f'{place}_')}")

    def _copy(self, key: str, to_key: str) -> None:
        values = self._values(ENTRIES[to_key])
        values[to_key] = self._values(ENTRIES[key]).get(key, ENTRIES[key].default)

    def _set_custom(self, name: str, value: str) -> None:
        prefix, _, what = name.rpartition("_")
        level = _LEVELS.get(prefix)
        if level is None or what not in ("id", "desc"):
            raise ConfigurationError(f"'custom:{name[:40]}' is no entry of the configuration")
        if what == "desc":
            self._described[level][self._current[level]] = _checked_text(f"custom:{name}", value)
        elif value.startswith("-"):
            self._delete(level, value[1:])
        else:
            self._select(level, value)

    def _select(self, level: Category, identifier: str) -> None:
        if not _ID.fullmatch(identifier):
            raise ConfigurationError(f"the identifier {identifier[:40]!r} must be letters and digits, at most 32")
        if identifier not in self._kept[level]:
            if len(self._kept[level]) >= KEPT_MAX:
                raise ConfigurationError(f"there are {KEPT_MAX} configurations of the level {level}; delete some")
            self._kept[level][identifier], self._described[level][identifier] = {}, ""
        self._current[level] = identifier

    def _delete(self, level: Category, identifier: str) -> None:
        gone = [each for each in self._kept[level] if each != DEFAULT_ID and identifier in ("all", each)]
        if not gone and identifier != "all":
            raise ConfigurationError(f"there is no configuration {identifier[:40]!r} of the level {level}")
        for each in gone:
            del self._kept[level][each], self._described[level][each]
        if self._current[level] not in self._kept[level]:
            self._current[level] = DEFAULT_ID


def _checked(key: str, entry: ConfigurationEntry, value: str) -> str:
    """Return a value as it is kept: a number within its range."""
    if entry.kind == "fixed":
        raise ConfigurationError(f"{key} is read only")
    if entry.kind == "text":
        return _checked_text(key, value)
    if entry.kind == "flag":
        flag = {"TRUE": "TRUE", "1": "TRUE", "FALSE": "FALSE", "0": "FALSE"}.get(value.strip().upper())
        if flag is None:
            raise ConfigurationError(f"{key} is set to {value[:40]!r}; must be TRUE or FALSE")
        return flag
    number = _number(key, value)
    number = min(max(number, entry.low), entry.high)
    return str(round(number)) if entry.kind == "whole" else f"{number:g}"


def _checked_text(key: str, value: str) -> str:
    if len(value) > TEXT_MAX or not value.isprintable():
        raise ConfigurationError(f"{key} is set to {value[:40]!r}; must be printable, at most {TEXT_MAX} characters")
    return value


def _number(key: str, value: str) -> float:
    try:
        number = float(value)
    except ValueError:
        number = math.nan
    if not math.isfinite(number):
        raise ConfigurationError(f"{key} is set to {value[:40]!r}; must be a number")
    return number
