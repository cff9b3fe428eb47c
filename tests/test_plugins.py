"""Every stage enters by the same door, and a plugin that cannot is told in one line."""

from __future__ import annotations

import importlib.metadata
from collections.abc import Callable
from pathlib import Path

import pytest

from workbench.plugins import GROUP, find_stages
from workbench.stage import StageError

STAGE = """
class Mine(Stage):
    name = "{name}"
    gives = (Artifact("{gives}", "float32", "H W"),)
"""


def test_the_stages_of_the_bench_come_through_entry_points(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    entries = importlib.metadata.entry_points(group=GROUP)
    assert {"registration", "focus_maps", "depth_cloud"} <= {entry.name for entry in entries}
    found = find_stages()
    assert set(found) == {entry.name for entry in entries}
    assert all(name == one.name for name, one in found.items())
    monkeypatch.setattr(importlib.metadata, "entry_points", lambda **_: ())
    assert find_stages() == {}


def test_an_entry_point_that_does_not_load_is_told_in_one_line(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    broken = importlib.metadata.EntryPoint("mine", "no.such.module:Mine", GROUP)
    monkeypatch.setattr(importlib.metadata, "entry_points", lambda **_: (broken,))
    with pytest.raises(StageError, match=r"mine.*no\.such\.module") as told:
        find_stages()
    assert "\n" not in str(told.value)


def test_a_file_adds_a_stage(plugin: Callable[[str], Path]) -> None:
    before = find_stages()
    found = find_stages([plugin(STAGE.format(name="mine", gives="x"))])
    assert list(found) == [*before, "mine"]


def test_a_file_replaces_a_stage_of_the_same_name(plugin: Callable[[str], Path]) -> None:
    path = plugin(STAGE.format(name="focus_maps", gives="x"))
    found = find_stages([path])
    assert set(found) == set(find_stages())
    assert type(found["focus_maps"]).__name__ == "Mine"


def test_a_later_file_replaces_an_earlier_one(plugin: Callable[[str], Path]) -> None:
    paths = [plugin(STAGE.format(name="mine", gives=artifact)) for artifact in "ab"]
    assert find_stages(paths)["mine"].gives[0].name == "b"
    assert find_stages(paths[::-1])["mine"].gives[0].name == "a"


def test_files_of_the_same_name_in_two_folders_do_not_mix(tmp_path: Path) -> None:
    paths = []
    for which in "ab":
        path = tmp_path / which / "stage.py"
        path.parent.mkdir()
        source = f"VALUE = '{which}'\n" + STAGE.format(name=f"mine_{which}", gives=which)
        path.write_text("from workbench import Artifact, Stage\n" + source)
        paths.append(path)
    found = find_stages(paths)
    assert {"mine_a", "mine_b"} <= set(found)
    assert type(found["mine_a"]).__module__ != type(found["mine_b"]).__module__


def test_a_stage_that_a_file_only_imports_is_not_its_own(plugin: Callable[[str], Path]) -> None:
    path = plugin(
        "from workbench_stages.focus_maps import FocusMaps\n"
        "class Other(FocusMaps):\n    name = 'other'\n    gives = (Artifact('o'),)\n"
    )
    found = find_stages([path])
    assert type(found["focus_maps"]).__name__ == "FocusMaps" and "other" in found


@pytest.mark.parametrize(
    ("source", "says"),
    [
        ("def (", "SyntaxError"),
        ("import nothing_of_this_name", "nothing_of_this_name"),
        ("raise ValueError('two\\nlines')", "two lines"),
        ("raise SystemExit(3)", "SystemExit"),
        ("X = 1", "no class derived from workbench.Stage"),
        ("class Mine(Stage):\n    pass", "Mine has no name"),
        ("class Mine(Stage):\n    name = 'm'\n    def __init__(self, x): pass", "Mine"),
        ("class Mine(Stage):\n    name = 'm'\n    needs = ('near',)", "near"),
        (STAGE.format(name="mine", gives="depth_m"), "depth_cloud and mine"),
        ("class Mine(Stage):\n    name = 'm'\n    needs = (Artifact('gold'),)", "gold"),
    ],
    ids=["syntax", "import", "two lines", "exit", "no stage", "no name", "constructor", "no need",
         "giver", "need"],
)  # fmt: skip
def test_a_broken_file_is_told_in_one_line(
    bench: Callable[..., object], plugin: Callable[[str], Path], source: str, says: str
) -> None:
    path = plugin(source)
    ended = bench("stages", "--plugin", path)
    assert ended.code in (1, 2)
    assert says in ended.mistake
    assert str(path) in ended.mistake or "mine" in ended.mistake or "m needs" in ended.mistake


def test_a_file_that_is_not_python_or_not_there_is_told_in_one_line(
    bench: Callable[..., object], tmp_path: Path
) -> None:
    binary = tmp_path / "binary.py"
    binary.write_bytes(bytes(range(256)))
    text = tmp_path / "stage.txt"
    text.write_text("words")
    for path in (binary, text, tmp_path, tmp_path / "nothing.py"):
        assert str(path) in bench("stages", "--plugin", path).mistake


def test_a_stage_of_ones_own_runs_beside_the_others(
    bench: Callable[..., object], plugin: Callable[[str], Path], scene: Path, tmp_path: Path
) -> None:
    path = plugin("""
class Edges(Stage):
    \"\"\"Vertical steps.\"\"\"
    name = "edges"
    needs = (Artifact("intensity", "float32", "H W"),)
    gives = (Artifact("steps", "float32", "H W"),)
    class Parameters(StageParameters):
        gain: float = knob(1.0, "Times this.", low=0, high=4, step=1, unit="times")
    def compute(self, inputs, parameters):
        steps = np.abs(np.diff(inputs["intensity"], axis=1, prepend=0)) * parameters.gain
        return {"steps": steps.astype(np.float32)}
""")
    ended = bench(
        "export", scene, "--to", tmp_path / "out", "--frames", "0:1", "--plugin", path,
        "--set", "edges.gain=2", "--artifacts", "steps,intensity", "--json",
    )  # fmt: skip
    assert ended.code == 0 and ended.json["provenance"]["changed"] == {"edges.gain": 2.0}
    assert "edges" in ended.json["provenance"]["code"]
