"""A digest changes with each part of what it identifies, and with nothing else."""

from __future__ import annotations

import hashlib
import importlib
import importlib.metadata
import itertools
import sys
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import workbench.digest as digests
from workbench.digest import digest_of, digest_of_code, digest_of_file
from workbench.plugins import GROUP, find_stages

# -- values ---------------------------------------------------------------------------------------

GRID = np.arange(6, dtype=np.int32).reshape(2, 3)

DIFFERENT: list[list[Any]] = [
    [],
    [""],
    ["a"],
    ["b"],
    ["ab"],
    ["a", "b"],
    ["b", "a"],
    ["ab", "c"],
    ["a", "bc"],
    [b"a"],
    ["b'a'"],
    [1],
    ["1"],
    [1.0],
    [2],
    [True],
    [None],
    ["None"],
    [GRID],
    [GRID.T],
    [GRID.reshape(3, 2)],
    [GRID.ravel()],
    [GRID[::-1]],
    [GRID[:, ::-1]],
    [GRID.astype(np.uint32)],
    [GRID.astype(">i4")],
    [GRID, GRID],
    [GRID[:1], GRID[1:]],
    [GRID.tobytes()],
    [np.zeros(0, np.int32)],
    [np.zeros((0, 3), np.int32)],
]


def test_no_two_different_values_share_a_digest() -> None:
    for one, other in itertools.combinations(range(len(DIFFERENT)), 2):
        assert digest_of(DIFFERENT[one]) != digest_of(DIFFERENT[other]), (one, other)


@pytest.mark.parametrize("place", [0, 1, 5])
def test_one_element_of_an_array_is_enough(place: int) -> None:
    other = GRID.copy()
    other.flat[place] += 1
    assert digest_of([other]) != digest_of([GRID])


def test_one_element_of_a_large_array_is_enough() -> None:
    array = np.zeros((100, 200))
    before = digest_of([array])
    array[50, 100] = 1e-12
    assert digest_of([array]) != before


def test_equal_values_have_one_digest_whatever_their_memory_looks_like() -> None:
    wide = np.zeros((2, 6), np.int32)
    wide[:, ::2] = GRID
    assert digest_of([wide[:, ::2]]) == digest_of([GRID]) == digest_of([np.asfortranarray(GRID)])
    assert digest_of(iter(["a", 1])) == digest_of(("a", 1))


def test_a_digest_is_32_hexadecimal_digits() -> None:
    assert len(digest_of(["x"])) == 32 and set(digest_of(["x"])) <= set("0123456789abcdef")


# -- files ----------------------------------------------------------------------------------------

BLOCK = 1 << 20


@pytest.mark.parametrize("size", [0, 1, BLOCK - 1, BLOCK, BLOCK + 1, 2 * BLOCK + 5])
def test_the_digest_of_a_file_is_that_of_all_its_bytes(tmp_path: Path, size: int) -> None:
    data = np.random.default_rng(size).bytes(size)
    path = tmp_path / "file"
    path.write_bytes(data)
    assert digest_of_file(path) == hashlib.blake2b(data, digest_size=16).hexdigest()


@pytest.mark.parametrize("place", [0, BLOCK - 1, BLOCK, 2 * BLOCK, 3 * BLOCK - 1])
def test_one_byte_of_a_large_file_is_enough(tmp_path: Path, place: int) -> None:
    path = tmp_path / "file"
    data = bytearray(3 * BLOCK)
    path.write_bytes(data)
    before = digest_of_file(path)
    data[place] = 1
    path.write_bytes(data)
    assert digest_of_file(path) != before


# -- code -----------------------------------------------------------------------------------------


@pytest.fixture
def code(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Callable[..., str]]:
    """Writes modules below folders on the path and gives the digest of the first one named."""
    written: set[str] = set()

    def digest(sources: dict[str, str], folder: str = "code", of: str | None = None) -> str:
        top = tmp_path / folder
        top.mkdir(parents=True, exist_ok=True)
        if str(top) not in sys.path:
            monkeypatch.syspath_prepend(str(top))
        for name, source in sources.items():
            path = top / f"{name}.py"
            path.parent.mkdir(parents=True, exist_ok=True)
            path.write_text(source)
            written.add(name.partition("/")[0])
        importlib.invalidate_caches()
        forget()
        return digest_of_code((of or next(iter(sources))).replace("/", "."))

    def forget() -> None:
        for name in [name for name in sys.modules if name.partition(".")[0] in written]:
            del sys.modules[name]
        digest_of_code.cache_clear()

    yield digest
    forget()


REACHED = {
    "import toy_helper": "toy_helper",
    "import toy_helper as other": "toy_helper",
    "from toy_helper import f": "toy_helper",
    "def late():\n    import toy_helper\n": "toy_helper",
    "try:\n    import toy_helper\nexcept ImportError:\n    pass\n": "toy_helper",
    "import toy_many.inner.deep": "toy_many/inner/deep",
    "from toy_many.inner import deep": "toy_many/inner/deep",
    "from toy_many import inner": "toy_many/inner/__init__",
    "from toy_many.inner.deep import f": "toy_many/inner/__init__",
    "import toy_many.inner": "toy_many/__init__",
}


@pytest.mark.parametrize("statement", REACHED)
def test_a_stage_is_as_much_as_the_modules_beside_it_that_it_imports(
    code: Callable[..., str], statement: str
) -> None:
    sources = {
        "toy_stage": statement,
        "toy_helper": "X = 1",
        "toy_many/__init__": "",
        "toy_many/inner/__init__": "",
        "toy_many/inner/deep": "Y = 1",
        "toy_other": "Z = 1",
    }
    before = code(sources)
    assert code(sources | {REACHED[statement]: "X = 2"}) != before
    assert code(sources | {"toy_other": "Z = 2"}) == before
    assert code(sources) == before


@pytest.mark.parametrize(
    ("place", "statement", "reached"),
    [
        ("toy_pack/stage", "from . import near", "toy_pack/near"),
        ("toy_pack/stage", "from .near import f", "toy_pack/near"),
        ("toy_pack/sub/stage", "from .. import near", "toy_pack/near"),
        ("toy_pack/sub/stage", "from ..near import f", "toy_pack/near"),
        ("toy_pack/sub/__init__", "from . import near", "toy_pack/sub/near"),
        ("toy_pack/sub/__init__", "from ..near import f", "toy_pack/near"),
    ],
)
def test_relative_imports_are_followed(
    code: Callable[..., str], place: str, statement: str, reached: str
) -> None:
    sources = {
        "toy_pack/__init__": "",
        "toy_pack/near": "X = 1",
        "toy_pack/sub/__init__": "",
        "toy_pack/sub/near": "X = 1",
    }
    of = place.removesuffix("/__init__")
    before = code(sources | {place: statement}, of=of)
    assert code(sources | {place: statement, reached: "X = 2"}, of=of) != before
    elsewhere = {"toy_pack/near", "toy_pack/sub/near"} - {reached}
    assert code(sources | {place: statement} | dict.fromkeys(elsewhere, "X = 2"), of=of) == before


def test_what_is_reached_through_others_counts_also_in_a_circle(code: Callable[..., str]) -> None:
    sources = {
        "toy_a": "import toy_b",
        "toy_b": "import toy_c",
        "toy_c": "import toy_a\nX = 1",
    }
    before = code(sources)
    assert code(sources | {"toy_c": "import toy_a\nX = 2"}) != before


def test_two_modules_that_change_places_are_other_code(code: Callable[..., str]) -> None:
    sources = {"toy_a": "import toy_b, toy_c", "toy_b": "X = 1", "toy_c": "X = 2"}
    before = code(sources)
    assert code(sources | {"toy_b": "X = 2", "toy_c": "X = 1"}) != before


@pytest.mark.parametrize("folder", ["lib/site-packages", "lib/dist-packages"])
def test_installed_packages_are_not_read_unless_the_stage_is_in_one(
    code: Callable[..., str], folder: str
) -> None:
    code({"toy_third/__init__": "", "toy_third/part": "X = 1"}, folder)
    stage = {"toy_stage": "import toy_third.part"}
    before = code(stage)
    code({"toy_third/part": "X = 2"}, folder)
    assert code(stage) == before
    own = {"toy_third/stage": "from . import part"}
    before = code(own, folder)
    assert code(own | {"toy_third/part": "X = 3"}, folder) != before


def test_what_comes_with_python_is_not_read(
    code: Callable[..., str], monkeypatch: pytest.MonkeyPatch
) -> None:
    read: list[str] = []
    whole = Path.read_bytes
    monkeypatch.setattr(Path, "read_bytes", lambda path: read.append(path.name) or whole(path))
    code({"toy_stage": "import json.decoder, colorsys, sys, numpy.linalg"})
    assert read == ["toy_stage.py"]


def test_installed_packages_that_bring_stages_are_read(
    code: Callable[..., str], monkeypatch: pytest.MonkeyPatch
) -> None:
    entry = importlib.metadata.EntryPoint("toy", "toy_brings.stage:Toy", GROUP)
    monkeypatch.setattr(
        importlib.metadata, "entry_points", lambda group: [entry] if group == GROUP else []
    )
    digests._stage_packages.cache_clear()
    try:
        folder = "lib/site-packages"
        code({"toy_brings/__init__": "", "toy_brings/part": "X = 1"}, folder)
        stage = {"toy_stage": "from toy_brings import part"}
        before = code(stage)
        code({"toy_brings/part": "X = 2"}, folder)
        assert code(stage) != before
    finally:
        digests._stage_packages.cache_clear()


def test_the_bench_counts_where_a_stage_reaches_into_it_and_its_door_does_not(
    code: Callable[..., str], monkeypatch: pytest.MonkeyPatch
) -> None:
    stages = {
        "toy_door": "from workbench import Stage",
        "toy_inside": "from workbench.files import replacing",
    }
    whole = Path.read_bytes

    def edited(path: Path) -> bytes:
        return whole(path) + (b"\nX = 2\n" if path.parent.name == "workbench" else b"")

    before = [code(stages, of=name) for name in stages]
    monkeypatch.setattr(Path, "read_bytes", edited)
    after = [code(stages, of=name) for name in stages]
    assert [one == other for one, other in zip(before, after, strict=True)] == [True, False]


def test_nothing_that_is_only_looked_at_is_imported(
    code: Callable[..., str], tmp_path: Path
) -> None:
    ran = tmp_path / "ran"
    code(
        {
            "toy_stage": "def f():\n    from toy_script.part import g",
            "toy_script/__init__": f"open({str(ran)!r}, 'w')",
            "toy_script/part": f"open({str(ran)!r}, 'w')",
        }
    )
    assert not ran.exists() and "toy_script" not in sys.modules


def test_a_helper_that_is_no_python_and_one_that_is_not_there_are_passed_over(
    code: Callable[..., str],
) -> None:
    sources = {
        "toy_stage": "try:\n    import toy_old, toy_not_there.at_all\nexcept Exception: pass\n",
        "toy_old": "print 'for another Python'",
    }
    before = code(sources)
    assert code(sources | {"toy_old": "print 'other'"}) != before


def test_a_plugin_that_uses_the_modules_of_a_built_in_stage_is_as_much_as_these(
    plugin: Callable[[str], Path], monkeypatch: pytest.MonkeyPatch
) -> None:
    import workbench_stages

    path = plugin(
        "from workbench_stages.edges.stack import *\n"
        "class Mine(Stage):\n    name = 'mine'\n    gives = (Artifact('m'),)\n"
    )
    module = type(find_stages([path])["mine"]).__module__
    shipped = Path(workbench_stages.__file__).parent
    read: list[str] = []
    whole = Path.read_bytes

    def noted(path: Path) -> bytes:
        if path.is_relative_to(shipped):
            read.append(path.relative_to(shipped).as_posix())
        return whole(path)

    def edited(path: Path) -> bytes:
        return whole(path) + (b"\nX = 2\n" if path == shipped / "edges" / "stack.py" else b"")

    digest_of_code.cache_clear()
    monkeypatch.setattr(Path, "read_bytes", noted)
    before = digest_of_code(module)
    assert {"edges/stack.py", "edges/__init__.py", "__init__.py"} <= set(read)
    assert "recognition.py" not in read
    monkeypatch.setattr(Path, "read_bytes", edited)
    digest_of_code.cache_clear()
    assert digest_of_code(module) != before
    digest_of_code.cache_clear()
