"""Parses ``--set`` options and applies them to the hand of a recording."""

from __future__ import annotations

import itertools
import tomllib
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

from skinnode.config import HandConfig, PatchConfig, SolverConfig, parse_hand
from skinnode.errors import ConfigError

_PATCH_KEYS: Final = ("relative_noise", "row_time_us", "calibration", "tolerances", "layout")
"""Patch keys that describe the skin rather than the patch's identity on the bus."""
_EVERY_PATCH: Final = "*"
_ALLOWED: Final = (
    "solver.KEY, or patches.NAME.KEY, where NAME is a patch or * for all, "
    f"and KEY is {', '.join(_PATCH_KEYS[:-1])} or {_PATCH_KEYS[-1]}, or a key of one of these tables"
)
_WITHOUT_LIMIT: Final = "no time limit, because the results would depend on the speed of the computer"
_LIVE: Final = {"deadline_us": _WITHOUT_LIMIT, "workers": "--processes instead"}
"""Solver keys used only by a live host."""


@dataclass(frozen=True, slots=True)
class Setting:
    """Key and value of an option."""

    key: str
    value: Any
    text: str
    """Value as the user wrote it."""


Variant = tuple[Setting, ...]
"""Settings of one combination of a sweep."""


def variants(options: Sequence[str]) -> list[Variant]:
    """Return all combinations of option values.

    Args:
        options: Texts ``KEY=VALUE`` or ``KEY=VALUE,VALUE,…``. Values are parsed as TOML; a value that is not
            valid TOML is a string.

    Raises:
        ConfigError: An option has no key or no value, has a key that cannot be set, or occurs twice.
    """
    found: dict[str, list[Setting]] = {}
    for option in options:
        key, equals, text = option.partition("=")
        key = key.strip()
        if not equals or not key or not text.strip():
            raise ConfigError("--set", option, "KEY=VALUE, or KEY=VALUE,VALUE,… for a sweep")
        _check(key)
        if key in found:
            raise ConfigError("--set", option, f"{key} only once; separate multiple values with commas")
        found[key] = [Setting(key, _value(part), part) for part in _split(text)]
    return list(itertools.product(*found.values()))


def apply(hand: HandConfig, variant: Variant) -> HandConfig:
    """Return a copy of the hand with the settings of a variant and without a time limit for solving.

    File names become absolute, because a worker may have a different working directory.

    Raises:
        ConfigError: A patch or a key does not exist, or a value is not allowed.
    """
    table = hand.table()
    for setting in variant:
        for path in _paths(hand, setting):
            _set(table, path, setting)
    solver = table.get("solver", {})
    for key in _LIVE:
        solver.pop(key, None)
    changed = parse_hand(table, folder=Path.cwd(), where="--set")
    for setting in variant:
        _require_effect(changed, setting)
    return changed


def name_of(variant: Variant) -> str:
    """Return a short description of a variant, such as ``method=exact drift=none``."""
    return " ".join(f"{setting.key.rpartition('.')[2]}={setting.text}" for setting in variant)


def _check(key: str) -> None:
    parts = key.split(".")
    if parts[0] == "solver" and len(parts) == 2:
        if parts[1] in _LIVE:
            raise ConfigError("--set", key, _LIVE[parts[1]])
        return
    if parts[0] == "patches" and len(parts) >= 3:
        _, wanted = _patch_and_key(key)
        if wanted[0] in _PATCH_KEYS:
            return
    raise ConfigError("--set", key, _ALLOWED)


def _patch_and_key(key: str) -> tuple[str, list[str]]:
    """Split ``patches.NAME.KEY``; NAME may contain dots and ends before the first patch key."""
    parts = key.split(".")[1:]
    for at in range(1, len(parts)):
        if parts[at] in PatchConfig.model_fields:
            return ".".join(parts[:at]), parts[at:]
    return parts[0], parts[1:]


def _paths(hand: HandConfig, setting: Setting) -> list[list[str | int]]:
    """Return the paths in a hand's table that a setting changes."""
    if setting.key.startswith("solver."):
        return [list(setting.key.split("."))]
    name, keys = _patch_and_key(setting.key)
    names = [patch.name for patch in hand.patches]
    if name != _EVERY_PATCH and name not in names:
        raise ConfigError("--set", setting.key, f"a patch of the recording: {', '.join(names)}; or * for all")
    return [["patches", i, *keys] for i, each in enumerate(names) if name in (_EVERY_PATCH, each)]


def _require_effect(hand: HandConfig, setting: Setting) -> None:
    """Raise ConfigError if a setting describes the layout of a patch whose node supplies its own."""
    if setting.key.startswith("solver."):
        return
    _, keys = _patch_and_key(setting.key)
    if keys[0] != "layout" or keys[1:] in ([], ["coordinates"]):
        return
    for path in _paths(hand, setting):
        patch = hand.patches[int(path[1])]
        if patch.layout.coordinates == "node":
            key = f"patches.{patch.name}.layout.coordinates"
            raise ConfigError(
                "--set", setting.key, f"only with {key}=preset, because the node supplied its layout"
            )


def _set(table: Any, path: list[str | int], setting: Setting) -> None:
    for part in path[:-1]:
        if isinstance(part, int):
            table = table[part]
            continue
        table = table.setdefault(part, {})
        if not isinstance(table, dict | list | tuple):
            raise ConfigError("--set", setting.key, f"{part} itself, which is not a table here")
    table[path[-1]] = setting.value


def _value(text: str) -> Any:
    try:
        return tomllib.loads(f"value = {text}")["value"]
    except tomllib.TOMLDecodeError:
        return text


def _split(text: str) -> list[str]:
    """Split a string at the commas outside brackets and quotes."""
    parts, depth, quote = [""], 0, ""
    for character in text:
        if quote:
            quote = "" if character == quote else quote
        elif character in "\"'":
            quote = character
        elif character == "," and not depth:
            parts.append("")
            continue
        else:
            depth += (character in "[{") - (character in "]}")
        parts[-1] += character
    return [part.strip() for part in parts]


def capture_hand(hand: HandConfig) -> HandConfig:
    """Return the hand without solver settings; variants with equal results share captured scans."""
    plain = PatchConfig(name="any", node_id=1)
    same = {key: getattr(plain, key) for key in ("row_time_us", "calibration", "tolerances")}
    patches = tuple(patch.model_copy(update=same) for patch in hand.patches)
    return hand.model_copy(update={"patches": patches, "solver": SolverConfig()})
