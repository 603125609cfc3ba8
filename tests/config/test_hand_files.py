"""Where in a file a mistake is, and layouts in files of their own."""

from __future__ import annotations

import json
import tomllib
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from skinnode.config import load_hand, load_layout
from skinnode.config.toml_text import places
from skinnode.errors import ConfigError
from skinnode.model.layout import PatchLayout

HEAD = '[[buses]]\nname = "can0"\n[[patches]]\nname = "thumb"\nnode_id = 1\n'


def test_places_by_eye() -> None:
    text = """# a comment with [brackets] = 3
top = 'a # b'
a."b c".d = 1
[table]   # [[not]]
  list = [ 1, "]", # }
    [2, 3],
  ]
[[many]]
x = {y = 1, z = [{w = 2}]}
[[many]]
[many.inner]
text = \"\"\"
[[many]] \\\"\"\" = 1
\"\"\"
last = 1979-05-27 07:32:00
"""
    tomllib.loads(text)
    found = places(text)
    assert found == {
        ("top",): (2, 1),
        ("a",): (3, 1),
        ("a", "b c"): (3, 1),
        ("a", "b c", "d"): (3, 1),
        ("table",): (4, 1),
        ("table", "list"): (5, 3),
        ("table", "list", 0): (5, 12),
        ("table", "list", 1): (5, 15),
        ("table", "list", 2): (6, 5),
        ("table", "list", 2, 0): (6, 6),
        ("table", "list", 2, 1): (6, 9),
        ("many",): (8, 1),
        ("many", 0): (8, 1),
        ("many", 0, "x"): (9, 1),
        ("many", 0, "x", "y"): (9, 6),
        ("many", 0, "x", "z"): (9, 13),
        ("many", 0, "x", "z", 0): (9, 18),
        ("many", 0, "x", "z", 0, "w"): (9, 19),
        ("many", 1): (10, 1),
        ("many", 1, "inner"): (11, 1),
        ("many", 1, "inner", "text"): (12, 1),
        ("many", 1, "inner", "last"): (15, 1),
    }


KEY = st.text(st.characters(codec="utf-8", exclude_categories=["Cs", "Cc"]), min_size=1, max_size=5)
VALUE = st.recursive(
    st.integers(0, 9) | st.booleans() | KEY,
    lambda inner: st.lists(inner, max_size=3) | st.dictionaries(KEY, inner, max_size=3),
    max_leaves=8,
)


def inline(value: Any) -> str:
    """As TOML on one line."""
    if isinstance(value, dict):
        return (
            "{"
            + ", ".join(f"{json.dumps(k, ensure_ascii=False)} = {inline(v)}" for k, v in value.items())
            + "}"
        )
    if isinstance(value, list):
        return "[" + ", ".join(map(inline, value)) + "]"
    return json.dumps(value, ensure_ascii=False)


def paths(value: Any, path: tuple[Any, ...] = ()) -> list[tuple[Any, ...]]:
    items = value.items() if isinstance(value, dict) else enumerate(value) if isinstance(value, list) else ()
    return [found for key, inner in items for found in ((*path, key), *paths(inner, (*path, key)))]


@pytest.mark.long
@settings(deadline=None)
@given(st.dictionaries(KEY, VALUE, max_size=5))
def test_every_key_of_any_document_has_its_place(table: dict[str, Any]) -> None:
    text = "".join(
        f"{json.dumps(key, ensure_ascii=False)} = {inline(value)}\n" for key, value in table.items()
    )
    assert tomllib.loads(text) == table
    found = places(text)
    assert set(found) == set(paths(table))
    assert [found[(key,)] for key in table] == [(number, 1) for number in range(1, len(table) + 1)]


@pytest.mark.parametrize(
    ("text", "says"),
    [
        (HEAD + "bus = 7\n", ":6:1: patches[0].bus: got 7, "),
        (HEAD.replace("node_id = 1\n", ""), ":3:1: patches[0].node_id: got nothing, "),
        (HEAD + "[patches.layout]\npitch_mm = 4\n", ":7:1: patches[0].layout.pitch_mm: got an unknown key, "),
        (
            HEAD + "pose = { position_m = [0.0, 'x', 1.0] }\n",
            ":6:29: patches[0].pose.position_m[1]: got 'x', ",
        ),
        (HEAD + '[[patches]]\nname = "b"\nnode_id = 1\n', ":8:1: patches[1].node_id: got 1, "),
    ],
)
def test_a_mistake_is_at_its_line_and_column(text: str, says: str, tmp_path: Path) -> None:
    path = tmp_path / "hand.toml"
    path.write_text(text.replace("\n", "\r\n") if "pose" in text else text, newline="")
    with pytest.raises(ConfigError) as caught:
        load_hand(path)
    assert str(caught.value).startswith(f"{path}{says}")


@pytest.fixture
def layout() -> PatchLayout:
    flat = PatchLayout.preset("staggered", upper_wires=2, upper_electrodes=3)
    bent_m = flat.upper_m.copy()
    bent_m[..., 2] += 1e-4 * np.arange(3)
    return PatchLayout(bent_m, flat.lower_m, 2e7)


@pytest.mark.parametrize("kind", ["npz", "toml"])
def test_electrodes_of_a_file(kind: str, layout: PatchLayout, tmp_path: Path) -> None:
    file = tmp_path / f"palm.{kind}"
    if kind == "npz":
        np.savez(file, upper_m=layout.upper_m, lower_m=layout.lower_m, resistivity_ohm_per_m=2e7)
    else:
        upper, lower = layout.upper_m.tolist(), layout.lower_m.tolist()
        file.write_text(f"upper_m = {upper}\nlower_m = {lower}\nresistivity_ohm_per_m = 2e7\n")
    path = tmp_path / "hand.toml"
    path.write_text(HEAD + f'layout.file = "palm.{kind}"\n')
    found = load_hand(path).patches[0].layout.build()
    assert found.layout_hash == layout.layout_hash
    assert (found.resistivity_ohm_per_m, found.name) == (2e7, "palm")


def test_keys_of_a_preset_in_a_file(tmp_path: Path) -> None:
    (tmp_path / "palm.toml").write_text('preset = "aligned"\nheight_m = 3e-3\n')
    path = tmp_path / "hand.toml"
    path.write_text(HEAD + 'layout.file = "palm.toml"\n')
    found = load_hand(path).patches[0].layout.build()
    assert found.layout_hash == PatchLayout.preset("aligned", height_m=3e-3).layout_hash


@pytest.mark.parametrize(
    ("name", "content", "says"),
    [
        ("none.npz", None, "allowed: the path of a layout file; there is no file"),
        ("bad.npz", b"once upon a time", "allowed: a layout (layout file: got "),
        (
            "bad.toml",
            b"upper_m = [[[0.0, 0.0, 1.0]]]",
            "lower_m: got nothing, allowed: an array of electrode positions",
        ),
        (
            "bad.toml",
            b"upper_m = [[0.0, 0.0, 1.0]]\nlower_m = [[[0.0, 0.0, 0.0]]]",
            "upper_m: got shape (1, 3), allowed: (U, N, 3)",
        ),
        (
            "bad.toml",
            b"upper_m = [[[0.0, 0.0, 1.0]]]\nlower_m = [[[0.0, 0.0, 0.0]]]\npitch_m = 1.0",
            "pitch_m: got an unknown key, allowed: one of upper_m, lower_m, resistivity_ohm_per_m",
        ),
        ("bad.toml", b'file = "bad.toml"', "file: got 'bad.toml', allowed: only in a hand file"),
        (
            "bad.toml",
            b"height_m = -1",
            "bad.toml:1:1: height_m: got -1, allowed: a number from 1e-6 to 1 (m)",
        ),
    ],
)
def test_layout_file_that_is_none(name: str, content: bytes | None, says: str, tmp_path: Path) -> None:
    if content is not None:
        (tmp_path / name).write_bytes(content)
    path = tmp_path / "hand.toml"
    path.write_text(HEAD + f'layout.file = "{name}"\n')
    with pytest.raises(ConfigError) as caught:
        load_hand(path)
    assert str(caught.value).startswith(f"{path}:6:1: patches[0].layout.file: got ")
    assert says in str(caught.value)
    assert "\n" not in str(caught.value)


def test_a_pickle_is_not_opened(tmp_path: Path) -> None:
    file = tmp_path / "palm.npz"
    np.savez(file, upper_m=np.array([{"a": 1}], dtype=object), lower_m=np.zeros((1, 1, 3)))
    with pytest.raises(ConfigError, match=r"palm\.npz.*an NPZ file \(Object arrays cannot be loaded"):
        load_layout(file)


def test_keys_beside_a_file(tmp_path: Path) -> None:
    (tmp_path / "palm.toml").write_text("")
    path = tmp_path / "hand.toml"
    path.write_text(HEAD + 'layout = { file = "palm.toml", pitch_m = 1e-3 }\n')
    with pytest.raises(ConfigError) as caught:
        load_hand(path)
    assert str(caught.value) == (
        f"{path}:6:32: patches[0].layout.pitch_m: got 0.001, allowed: only without layout.file"
    )
