"""A sweep in Rerun: what is in its files, the server's cards, and nothing written twice."""

from __future__ import annotations

import shlex
import socket
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pyarrow.parquet as pq
import pytest
from conftest import Command
from test_sweep import GRID, TINY, swept

from workbench.sweep.axes import Axis
from workbench.sweep.charts import digits, heat_chart, line_chart
from workbench.sweep.table import Metric


@pytest.fixture
def tiny(plugin: Callable[[str], Path]) -> Path:
    """Two quick stages that write down each of their calls."""
    return plugin(TINY)


def schema_of(path: Path) -> set[str]:
    """Entities and timelines of an .rrd."""
    from rerun.chunk import RrdReader

    schema = RrdReader(str(path)).store().schema()
    entities = {column.entity_path for column in schema.component_columns()}
    return entities | {column.name for column in schema.index_columns()}


def test_every_cell_has_a_card_and_every_parameter_a_timeline(
    bench: Command, scene: Path, tiny: Path
) -> None:
    swept(bench, scene, tiny, *GRID, "--workers", 1)
    cells = sorted(Path("out/gallery").glob("*.rrd"))
    assert [path.stem for path in cells] == [f"{n:04d}" for n in range(9)]
    assert {"/picture", "/figure", "/about", "frame"} <= schema_of(cells[0])
    overview = schema_of(Path("out/sweep.rrd"))
    assert {"cell", "dark.level", "darkest.rows"} <= overview
    assert "/charts/darkest/agreed/map_0_1/map" in overview
    assert {"/charts/darkest/agreed/curve_0/lines", "/walk/cell", "/summary"} <= overview


def test_the_gallery_is_served_on_loopback_with_parameters_and_scores(
    bench: Command, scene: Path, tiny: Path
) -> None:
    from rerun.catalog import CatalogClient

    from workbench.sweep.gallery import served

    swept(bench, scene, tiny, *GRID, "--workers", 1)
    rows = pq.read_table("out/cells.parquet").to_pylist()
    with served(Path("out")) as address:
        host, _, port = address.partition("://")[2].partition("/")[0].partition(":")
        assert host == "127.0.0.1"
        with pytest.raises(OSError), socket.create_connection((_own_address(), int(port)), 0.5):
            pass
        dataset = CatalogClient(address.partition("/dataset")[0]).get_dataset("sweep")
        table = dataset.segment_table().to_pandas()
        assert dataset.default_segment_table_blueprint() is not None
    assert len(table) == 9
    for _, found in table.iterrows():
        row = rows[int(found["property:run:cell"][0])]
        assert found["property:axes:dark_level"][0] == row["dark.level"]
        score = found["property:scores:darkest_agreed"][0]
        assert score == pytest.approx(row["darkest.agreed"], rel=1e-5)
        assert "--config out/cells/" in found["property:run:open"][0]


def _own_address() -> str:
    """An address of this machine that is not loopback, or one that never answers."""
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe:
        try:
            probe.connect(("192.0.2.1", 9))
            address: str = probe.getsockname()[0]
        except OSError:
            address = "192.0.2.1"
    return address


def test_the_line_of_a_cell_shows_its_full_stack(bench: Command, scene: Path, tiny: Path) -> None:
    from workbench.commands.sweep import replay_line
    from workbench.session import Options
    from workbench.sweep.run import Request, run

    options = Options(scene, until="darkest", plugins=[tiny], frames=(0, 2))
    request = Request(options, [scene], Path("out"), ["darkest.rows=0,20"], workers=1)
    sweep = run(request)
    words = shlex.split(replay_line(sweep, sweep.configurations[1], "1:2"))
    assert words[0] == "workbench"
    ended = bench(*words[1:], "--save", "cell.rrd", "--json", "-")
    assert (ended.code, ended.json["frames"]) == (0, 1)
    assert ended.json["provenance"]["changed"] == {"darkest.rows": 20}


def test_what_did_not_change_is_not_written_again(bench: Command, scene: Path, tiny: Path) -> None:
    def stamps() -> dict[str, int]:
        files = [*Path("out/gallery").glob("*.rrd"), Path("out/sweep.rrd")]
        return {path.name: path.stat().st_mtime_ns for path in files}

    swept(bench, scene, tiny, *GRID, "--workers", 1)
    before = stamps()
    swept(bench, scene, tiny, *GRID, "--workers", 1)
    assert stamps() == before
    swept(bench, scene, tiny, "--axis", "dark.level=60,90", "--metric", "darkest.agreed")
    assert set(stamps()) == {"0000.rrd", "0001.rrd", "sweep.rrd"}
    assert sorted(path.name for path in Path("out/cells").iterdir()) == ["0000.toml", "0001.toml"]


def test_a_sweep_without_a_chosen_figure_has_a_gallery_too(
    bench: Command, scene: Path, tiny: Path
) -> None:
    swept(bench, scene, tiny, *GRID, "--workers", 1)
    ended = bench(
        *("sweep", scene, "--plugin", tiny, "--until", "darkest", "--frames", "0:3"),
        *("--axis", "dark.level=60,90", "--to", "out", "--pictures", 0),
    )
    assert ended.code == 0, ended.err
    assert "choose by one with --metric" in ended.out
    assert "dark.share" in ended.out
    assert not Path("out/best.toml").exists()
    assert len(list(Path("out/gallery").glob("*.rrd"))) == 2


def test_frames_of_several_recordings_follow_one_another() -> None:
    from workbench.sweep.gallery import _position

    # The second frame of the first recording does not decode.
    sweep: Any = SimpleNamespace(frames=[[1, 3], [1, 2], [0, 5]])
    places = [_position(sweep, r, f) for r, frames in enumerate(sweep.frames) for f in frames]
    assert places == [1, 3, 4, 5, 6, 7]


def test_workers_never_import_rerun() -> None:
    says = subprocess.run(
        [
            sys.executable,
            "-c",
            "import sys, workbench.sweep.worker, workbench.sweep.engines; "
            "import workbench_stages.pictures; "
            "print([m for m in ('rerun', 'typer', 'pyarrow') if m in sys.modules])",
        ],
        capture_output=True,
        text=True,
        check=True,
    ).stdout
    assert says.strip() == "[]"


def test_a_heat_map_frames_the_chosen_cell_and_leaves_holes() -> None:
    x, y = Axis("s.a", (1, 2, 3)), Axis("s.b", (0.5, 1.0))
    values = {(0, 0): 1.0, (1, 0): 3.0, (2, 0): 2.0, (0, 1): 0.0}
    for better, top in (("higher", (1, 0)), ("lower", (0, 1))):
        metric = Metric("t.m", "m", better=better)  # type: ignore[arg-type]
        chart = heat_chart(x, y, values, top, metric, 10)
        assert chart.image is not None
        height, width = chart.image.shape[0] // 2, chart.image.shape[1] // 3

        # One pixel of each cell; the least value of y is at the bottom.
        colours = chart.image[1::height, 1::width].astype(int)[::-1]
        assert max(values, key=lambda place: colours[place[1], place[0]].sum()) == top
        assert np.array_equal(colours[1, 1], colours[1, 2])
        box = np.array(chart.strips[0])
        assert box[:, 0].min() == top[0] * width
        assert box[:, 1].max() == (2 - top[1]) * height
        assert [text for _, _, text in chart.values] == ["0.00", "1.00", "3.00", "2.00"]
    assert heat_chart(x, y, values, (0, 0), metric, 2).values == []


def test_a_curve_marks_the_chosen_value() -> None:
    axis = Axis("s.a", (1.0, 2.0, 4.0))
    chart = line_chart(axis, [(0, 5.0), (2, 7.0)], 2, Metric("t.m", "m", "mm"))
    _, mark, line = chart.strips
    assert mark[0][0] == mark[1][0] == line[-1][0]
    assert line[1][1] < line[0][1]
    assert {"5.00 mm", "7.00 mm", "1", "4"} <= {text for _, _, text in chart.labels}
    assert line_chart(axis, [], 0, Metric("t.m", "m")).strips == []
    assert (digits([0.5, 0.7]), digits([0.90701, 0.90702]), digits([1.0, 1.0])) == (3, 5, 3)
