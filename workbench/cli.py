"""The command line.  Declares flags; the work is in ``workbench.commands``, imported late.

Exit codes: 0 done, 1 the data or the run failed, 2 wrong usage.
"""

from __future__ import annotations

import io
import sys
from pathlib import Path
from typing import Annotated, Any

import typer

from workbench import interrupts
from workbench.errors import (
    EXIT_FAILED,
    EXIT_INTERRUPTED,
    EXIT_USAGE,
    DataError,
    UsageError,
    one_line,
)
from workbench.samples import located

app = typer.Typer(
    name="workbench",
    help="An interactive debugging bench for vision pipelines: replay a recording through its "
    "stages, see every intermediate result, measure it against ground truth.",
    no_args_is_help=True,
    add_completion=True,
    pretty_exceptions_enable=False,
    rich_markup_mode=None,
)

Rec = Annotated[
    Path,
    typer.Argument(
        help="The recording, an MCAP file; sample:scene is one that comes with the package.",
        metavar="REC",
        parser=located,
    ),
]
Calibration = Annotated[
    Path | None,
    typer.Option(help="Calibration file; the one beside the recording if not given."),
]
Models = Annotated[
    Path | None,
    typer.Option(help="Model database; the one beside the recording if not given."),
]
Preset = Annotated[str | None, typer.Option(help="Named set of parameters.")]
Config = Annotated[
    Path | None,
    typer.Option(help="TOML with parameters, laid over the preset."),
]
Set = Annotated[
    list[str] | None,
    typer.Option(
        "--set", help="One parameter, over preset and file.", metavar="STAGE.PARAMETER=VALUE"
    ),
]
Topic = Annotated[
    list[str] | None,
    typer.Option(help="Where a channel's images are.", metavar="CHANNEL=/TOPIC"),
]
Frames = Annotated[
    str | None,
    typer.Option(help="Only these frames, as A:B (B not included), A: or :B.", metavar="A:B"),
]
Until = Annotated[
    str | None,
    typer.Option(help="Stop after this stage.", metavar="STAGE"),
]
Plugin = Annotated[
    list[Path] | None,
    typer.Option(help="A Python file with stages of your own.", metavar="FILE"),
]
Json = Annotated[bool, typer.Option("--json", help="Print JSON instead of tables.")]


def _options(
    recording: Path,
    calibration: Path | None,
    models: Path | None,
    preset: str | None,
    config: Path | None,
    assignments: list[str] | None,
    topic: list[str] | None,
    frames: str | None,
    until: str | None,
    plugin: list[Path] | None,
) -> Any:
    from workbench.session import Options

    resources = {"calibration": calibration, "models": models}
    return Options(
        recording,
        {name: path for name, path in resources.items() if path is not None},
        preset,
        config,
        assignments or [],
        parse_topics(topic or []),
        parse_frames(frames),
        until,
        plugin or [],
    )


def parse_frames(text: str | None) -> tuple[int, int | None]:
    """``A:B`` as (A, B); an end that is not given is 0 or None.  Raises :class:`UsageError`."""
    if text is None:
        return 0, None
    first, colon, last = text.partition(":")
    try:
        start = int(first) if first else 0
        stop = (int(last) if last else None) if colon else start + 1
    except ValueError:
        start, stop = -1, None
    if start < 0 or (stop is not None and stop <= start):
        raise UsageError(f"--frames {text}: expected A:B with 0 <= A < B")
    return start, stop


def parse_topics(texts: list[str]) -> dict[str, str]:
    """``CHANNEL=/TOPIC`` texts as a mapping.  Raises :class:`UsageError`."""
    topics = {}
    for text in texts:
        channel, equals, topic = text.partition("=")
        if not (channel and equals and topic):
            raise UsageError(f"--topic {text}: expected CHANNEL=/TOPIC")
        topics[channel] = topic
    return topics


def parse_size(flag: str, text: str) -> tuple[int, int]:
    """``WxH`` as (width, height).  Raises :class:`UsageError`."""
    width, _, height = text.lower().partition("x")
    if not (width.isdecimal() and height.isdecimal() and int(width) and int(height)):
        raise UsageError(f"{flag} {text}: expected WxH in pixels, such as 1920x1080")
    return int(width), int(height)


@app.command()
def replay(
    recording: Rec,
    save: Annotated[Path | None, typer.Option(help="Keep what is shown in this .rrd file.")] = None,
    screenshot: Annotated[
        Path | None, typer.Option(help="Take a picture (PNG) of the viewer; needs no screen.")
    ] = None,
    web: Annotated[bool, typer.Option("--web", help="Show it in a browser.")] = False,
    report: Annotated[
        Path | None,
        typer.Option("--json", help="Write the report to this file (-: standard output)."),
    ] = None,
    window: Annotated[
        str, typer.Option(help="Size of the screenshot's window.", metavar="WxH")
    ] = "1920x1080",
    calibration: Calibration = None,
    models: Models = None,
    preset: Preset = None,
    config: Config = None,
    assignments: Set = None,
    topic: Topic = None,
    frames: Frames = None,
    until: Until = None,
    plugin: Plugin = None,
) -> None:
    """Run a recording through the stages and show every result in Rerun."""
    from workbench.commands import replay as command

    options = _options(
        recording, calibration, models, preset, config, assignments, topic, frames, until, plugin
    )
    command.run(options, save, screenshot, web, report, window)


@app.command()
def info(recording: Rec, topic: Topic = None, as_json: Json = False) -> None:
    """What is in a recording: topics, schemas, frames, pairs, rates, and every defect found."""
    from workbench.commands import info as command

    command.run(recording, parse_topics(topic or []), as_json)


@app.command()
def stages(
    name: Annotated[str | None, typer.Argument(help="Only this stage.")] = None,
    plugin: Plugin = None,
    as_json: Json = False,
) -> None:
    """The stages and their parameters, with ranges, units and reasons."""
    from workbench.commands import stages as command

    command.run(name, plugin or [], as_json)


@app.command()
def export(
    recording: Rec,
    to: Annotated[Path, typer.Option(help="Folder to write to.", metavar="DIR")],
    artifacts: Annotated[
        str | None, typer.Option(help="Only these artifacts.", metavar="A,B")
    ] = None,
    calibration: Calibration = None,
    models: Models = None,
    preset: Preset = None,
    config: Config = None,
    assignments: Set = None,
    topic: Topic = None,
    frames: Frames = None,
    until: Until = None,
    plugin: Plugin = None,
    as_json: Json = False,
) -> None:
    """Write artifacts as frame_000000.npz and one line a frame in results.jsonl."""
    from workbench.commands import export as command

    options = _options(
        recording, calibration, models, preset, config, assignments, topic, frames, until, plugin
    )
    command.run(options, to, artifacts, as_json)


@app.command()
def tune(
    recording: Rec,
    port: Annotated[
        int | None, typer.Option(help="The page's port on loopback; a free one if not given.")
    ] = None,
    browser: Annotated[
        bool, typer.Option("--browser/--no-browser", help="Open the page in the browser.")
    ] = True,
    native: Annotated[
        bool, typer.Option("--native", help="Use Rerun's own window, with sliders alone.")
    ] = False,
    calibration: Calibration = None,
    models: Models = None,
    preset: Preset = None,
    config: Config = None,
    assignments: Set = None,
    topic: Topic = None,
    frames: Frames = None,
    until: Until = None,
    plugin: Plugin = None,
    as_json: Json = False,
) -> None:
    """Turn the stages' knobs beside the viewer; only what is downstream runs again."""
    from workbench.commands import tune as command

    options = _options(
        recording, calibration, models, preset, config, assignments, topic, frames, until, plugin
    )
    command.run(options, port, browser, native, as_json)


@app.command()
def evaluate(
    recording: Rec,
    calibration: Calibration = None,
    models: Models = None,
    preset: Preset = None,
    config: Config = None,
    assignments: Set = None,
    topic: Topic = None,
    frames: Frames = None,
    until: Until = None,
    plugin: Plugin = None,
    as_json: Json = False,
) -> None:
    """Measure the stages against the ground truth in the recording."""
    from workbench.commands import evaluate as command

    options = _options(
        recording, calibration, models, preset, config, assignments, topic, frames, until, plugin
    )
    command.run(options, as_json)


@app.command()
def compare(
    files: Annotated[
        list[Path],
        typer.Argument(
            help="A recording, to run under both configurations; or two saved replays (.rrd).",
            metavar="REC | A.rrd B.rrd",
            parser=located,
        ),
    ],
    a: Annotated[
        str | None,
        typer.Option(
            help="What is held against: a preset, a TOML file or stage.parameter=value[,…]; if "
            "not given, what --preset, --config and --set say.",
            metavar="CONFIG",
        ),
    ] = None,
    b: Annotated[
        str | None,
        typer.Option(help="What is held against A, in the same ways.", metavar="CONFIG"),
    ] = None,
    save: Annotated[Path | None, typer.Option(help="Keep what is shown in this .rrd file.")] = None,
    screenshot: Annotated[
        Path | None, typer.Option(help="Take a picture (PNG) of the viewer; needs no screen.")
    ] = None,
    web: Annotated[bool, typer.Option("--web", help="Show it in a browser.")] = False,
    window: Annotated[
        str, typer.Option(help="Size of the screenshot's window.", metavar="WxH")
    ] = "1920x1080",
    show: Annotated[
        str | None,
        typer.Option(help="Open on this stage's tab instead of the summary.", metavar="STAGE"),
    ] = None,
    calibration: Calibration = None,
    models: Models = None,
    preset: Preset = None,
    config: Config = None,
    assignments: Set = None,
    topic: Topic = None,
    frames: Frames = None,
    until: Until = None,
    plugin: Plugin = None,
    as_json: Json = False,
) -> None:
    """Hold two configurations, or two saved replays, against each other.

    Tells which parameters, digests, results, scores and times differ, and shows A, B and their
    difference side by side. Exits with 0 whether or not there is a difference; 1 means that the
    data or a run failed.
    """
    from workbench.commands import compare as command

    options = _options(
        files[0], calibration, models, preset, config, assignments, topic, frames, until, plugin
    )
    command.run(files, options, a, b, save, screenshot, web, window, show, as_json)


@app.command()
def calibrate(
    output: Annotated[Path, typer.Option("-o", "--output", help="The file to write.")],
    recording: Annotated[
        Path | None,
        typer.Argument(
            help="The recording of known planes; with --from-optics, one of any scene that "
            "tells the images' size.",
            metavar="REC",
            parser=located,
        ),
    ] = None,
    from_optics: Annotated[
        Path | None,
        typer.Option(
            "--from-optics",
            help="Calibrate from the lens's data alone: a rig.toml, or a recording that has a rig.",
            metavar="RIG",
            parser=located,
        ),
    ] = None,
    image_size: Annotated[
        str | None,
        typer.Option(
            "--image-size",
            help="With --from-optics and no recording: the size of the images; any, if not given.",
            metavar="WxH",
        ),
    ] = None,
    assignments: Set = None,
    topic: Topic = None,
    plugin: Plugin = None,
    as_json: Json = False,
) -> None:
    """Calibrate from a recording of known planes (and dot grids), or from the optics alone.

    From the optics alone depth comes from the texture of the scene itself: for pictures with lens
    data (focal_length_mm, f_number, pixel_pitch_mm, near_focus_mm, far_focus_mm in a TOML file)
    and no planes of known distance.  The report says what is assumed.
    """
    from workbench.commands import calibrate as command

    topics, plugins = parse_topics(topic or []), plugin or []
    if from_optics is not None:
        size = None if image_size is None else parse_size("--image-size", image_size)
        command.run_from_optics(
            from_optics, recording, size, output, assignments or [], topics, plugins, as_json
        )
        return
    if recording is None:
        raise UsageError("calibrate: expected a recording of known planes, or --from-optics")
    if image_size is not None:
        raise UsageError("--image-size: expected with --from-optics")
    command.run(recording, output, assignments or [], topics, plugins, as_json)


@app.command("import")
def import_(
    output: Annotated[Path, typer.Option("-o", "--output", help="The recording to write.")],
    near: Annotated[
        str | None,
        typer.Option(
            help="The near-focused image: a file, a folder, or a pattern with one * (quoted).",
            metavar="FILES",
        ),
    ] = None,
    far: Annotated[
        str | None, typer.Option(help="The far-focused image, likewise.", metavar="FILES")
    ] = None,
    flat: Annotated[
        str | None,
        typer.Option(
            help="An image without projected pattern on the near one's grid, likewise.",
            metavar="FILES",
        ),
    ] = None,
    channel: Annotated[
        list[str] | None,
        typer.Option(help="Images of any other channel, likewise.", metavar="CHANNEL=FILES"),
    ] = None,
    stack: Annotated[
        Path | None,
        typer.Option(
            help="A focal stack in place of pairs, nearest focus first: a folder, or a TIFF with "
            "pages.",
        ),
    ] = None,
    planes: Annotated[
        str | None,
        typer.Option(
            help="Which two images of the stack are near and far, counted from 0; else the two "
            "between which the scene is sharp.",
            metavar="I,J",
        ),
    ] = None,
    rig: Annotated[
        Path | None,
        typer.Option(help="The optics (TOML): gives the recording its cameras and its rig."),
    ] = None,
    rate: Annotated[
        float | None,
        typer.Option(
            help="Frames a second; else the times in the images (EXIF), else one a second.",
            metavar="HZ",
        ),
    ] = None,
    transfer: Annotated[
        str,
        typer.Option(
            help="How grey levels follow light: linear (stored as they are), or srgb, as cameras "
            "develop JPEGs (stored as linear 16 bit).",
            metavar="linear|srgb",
        ),
    ] = "linear",
    plugin: Plugin = None,
    as_json: Json = False,
) -> None:
    """Make a recording of image files: one pair, folders of pairs, or a focal stack.

    Files of two folders belong together if their names are alike, else by their order.  PNG and
    JPEG files are stored byte for byte, anything else as PNG.
    """
    from workbench.commands import import_ as command

    if transfer not in ("linear", "srgb"):
        raise UsageError(f"--transfer {transfer}: expected linear or srgb")
    sources = {
        name: text
        for name, text in (("near", near), ("far", far), ("flat", flat))
        if text is not None
    }
    for text in channel or []:
        name, equals, files = text.partition("=")
        if not (name and equals and files) or not name.replace("_", "").isalnum():
            raise UsageError(f"--channel {text}: expected CHANNEL=FILES")
        sources[name] = files
    options = command.ImportOptions(
        sources,
        stack,
        planes,
        rig,
        rate,
        "srgb" if transfer == "srgb" else "linear",
        output,
        plugin or [],
    )
    command.run(options, as_json)


@app.command()
def train(
    recordings: Annotated[
        list[Path],
        typer.Argument(
            help="Recordings, each of one part lying flat.", metavar="REC…", parser=located
        ),
    ],
    output: Annotated[Path, typer.Option("-o", "--output", help="The file to write.")],
    calibration: Calibration = None,
    label: Annotated[
        list[str] | None,
        typer.Option(help="The part's name, once for each recording; else the ground truth's."),
    ] = None,
    angles: Annotated[
        str | None,
        typer.Option(help="Degrees of the frames, separated by commas; else the ground truth's."),
    ] = None,
    save: Annotated[
        Path | None, typer.Option(help="Keep pictures of what training found in this .rrd file.")
    ] = None,
    screenshot: Annotated[
        Path | None, typer.Option(help="Take a picture (PNG) of them; needs no screen.")
    ] = None,
    assignments: Set = None,
    topic: Topic = None,
    plugin: Plugin = None,
    as_json: Json = False,
) -> None:
    """Train the database of parts: features of their surfaces, and eigenspaces."""
    from workbench.commands import train as command

    command.run(
        recordings,
        output,
        calibration,
        label or [],
        angles,
        assignments or [],
        parse_topics(topic or []),
        plugin or [],
        save,
        screenshot,
        as_json,
    )


@app.command()
def why(
    recording: Rec,
    frame: Annotated[int, typer.Option(help="The frame, counted from 0.", metavar="N")],
    pixel: Annotated[str, typer.Option(help="The pixel: column and row, from 0.", metavar="X,Y")],
    stage: Annotated[
        str | None,
        typer.Option(
            help="Turn this stage's verdict; the last that is on this very pixel if not given."
        ),
    ] = None,
    search: Annotated[
        bool, typer.Option("--search/--no-search", help="Look for the smallest change.")
    ] = True,
    save: Annotated[
        Path | None, typer.Option(help="Keep the pictures and the story in this .rrd file.")
    ] = None,
    screenshot: Annotated[
        Path | None, typer.Option(help="Take a picture (PNG) of the viewer; needs no screen.")
    ] = None,
    window: Annotated[
        str, typer.Option(help="Size of the screenshot's window.", metavar="WxH")
    ] = "1920x1080",
    calibration: Calibration = None,
    models: Models = None,
    preset: Preset = None,
    config: Config = None,
    assignments: Set = None,
    topic: Topic = None,
    until: Until = None,
    plugin: Plugin = None,
    as_json: Json = False,
) -> None:
    """A pixel's story through the stages, and the smallest change that would turn its verdict."""
    from workbench.commands import why as command

    options = _options(
        recording, calibration, models, preset, config, assignments, topic, None, until, plugin
    )
    command.run(options, frame, pixel, stage, search, as_json, save, screenshot, window)


@app.command()
def simulate(
    scene: Annotated[Path, typer.Argument(help="The scene file, TOML.", metavar="SCENE")],
    output: Annotated[Path, typer.Option("-o", "--output", help="The recording to write.")],
    seed: Annotated[
        int, typer.Option(min=0, help="Of everything random; the same seed, the same bytes.")
    ] = 0,
    frames: Frames = None,
    as_json: Json = False,
) -> None:
    """Render a scene file to a recording with ground truth."""
    from workbench.commands import simulate as command

    command.run(scene, output, seed, parse_frames(frames), as_json)


@app.command()
def sweep(
    recordings: Annotated[
        list[Path],
        typer.Argument(help="Recordings, MCAP files.", metavar="REC…", parser=located),
    ],
    axis: Annotated[
        list[str] | None,
        typer.Option(
            help="A parameter and its values: A,B,C or LO:HI:STEP or LO:HI:xN (N values, equal "
            "factors apart).",
            metavar="STAGE.PARAMETER=VALUES",
        ),
    ] = None,
    zipped: Annotated[
        list[str] | None,
        typer.Option(
            "--zip", help="Axes that move together instead of crossing.", metavar="AXIS,AXIS"
        ),
    ] = None,
    sample: Annotated[
        int | None, typer.Option(help="Only so many cells, drawn from the grid.", metavar="N")
    ] = None,
    seed: Annotated[int, typer.Option(help="What --sample draws by.")] = 0,
    metric: Annotated[
        list[str] | None,
        typer.Option(
            help="What the best cell is chosen by (the first), and what is drawn; without one the "
            "figures that there are get listed.",
            metavar="STAGE.FIGURE",
        ),
    ] = None,
    workers: Annotated[
        int | None, typer.Option(help="Processes; one for each core if not given.")
    ] = None,
    scheduler: Annotated[
        str | None,
        typer.Option(help="A Dask scheduler to work on instead.", metavar="tcp://HOST:PORT"),
    ] = None,
    to: Annotated[
        Path | None,
        typer.Option(
            help="Folder for tables, gallery and kept results; REC-sweep here if not given.",
            metavar="DIR",
        ),
    ] = None,
    pictures: Annotated[int, typer.Option(help="Frames of which each cell keeps a picture.")] = 4,
    view: Annotated[
        bool | None,
        typer.Option("--view/--no-view", help="Open the gallery; if not given, on a display."),
    ] = None,
    screenshot: Annotated[
        Path | None,
        typer.Option(
            help="Take a picture (PNG) of the gallery, and NAME-grid.png of the heat maps; needs "
            "no screen."
        ),
    ] = None,
    window: Annotated[
        str, typer.Option(help="Size of the screenshot's window.", metavar="WxH")
    ] = "1920x1080",
    calibration: Calibration = None,
    models: Models = None,
    preset: Preset = None,
    config: Config = None,
    assignments: Set = None,
    topic: Topic = None,
    frames: Frames = None,
    until: Until = None,
    plugin: Plugin = None,
    as_json: Json = False,
) -> None:
    """Try a grid of parameters; what cells have in common is computed once and kept."""
    from workbench.commands import sweep as command
    from workbench.sweep.run import Request

    options = _options(
        recordings[0],
        calibration,
        models,
        preset,
        config,
        assignments,
        topic,
        frames,
        until,
        plugin,
    )
    request = Request(
        options,
        recordings,
        to or Path(f"{recordings[0].stem}-sweep"),
        axis or [],
        zipped or [],
        sample,
        seed,
        metric or [],
        workers,
        scheduler,
        pictures,
    )
    command.run(request, view, screenshot, window, as_json)


@app.command()
def teach(
    lesson: Annotated[int | None, typer.Option(help="Open this lesson.", metavar="N")] = None,
    listing: Annotated[bool, typer.Option("--list", help="List the lessons.")] = False,
    save: Annotated[
        Path | None,
        typer.Option(help="Write the lesson, or all of them, to this .rrd file to hand out."),
    ] = None,
    screenshot: Annotated[
        Path | None, typer.Option(help="Take a picture (PNG) of the lesson; needs no screen.")
    ] = None,
    assignments: Set = None,
    no_browser: Annotated[
        bool, typer.Option("--no-browser", help="Serve the page and print its address only.")
    ] = False,
    as_json: Annotated[
        bool, typer.Option("--json", help="Check what the lessons claim and print it as JSON.")
    ] = False,
    window: Annotated[
        str, typer.Option(help="Size of the screenshot's window.", metavar="WxH")
    ] = "1600x900",
) -> None:
    """A course of short lessons: a text beside live pictures and a few knobs."""
    from workbench.commands import teach as command

    command.run(lesson, listing, save, screenshot, assignments or [], no_browser, as_json, window)


def main() -> None:
    """Run the command line; a user's mistake is one line, never a traceback."""
    interrupts.install()
    for stream in (sys.stdout, sys.stderr):
        # A terminal of few characters shows the others as question marks.
        if isinstance(stream, io.TextIOWrapper):
            stream.reconfigure(errors="replace")
    try:
        code = app(standalone_mode=False) or 0
    except (KeyboardInterrupt, typer.Abort):
        code = EXIT_INTERRUPTED
    except UsageError as error:
        print(f"workbench: {one_line(error)}", file=sys.stderr)
        code = EXIT_USAGE
    except (DataError, OSError) as error:
        print(f"workbench: {one_line(error)}", file=sys.stderr)
        code = EXIT_FAILED
    except ImportError as error:
        # A library that is not there, or that lacks another; in our own modules it is a bug.
        if (error.name or "").startswith("workbench"):
            raise
        print(f"workbench: {one_line(error)}", file=sys.stderr)
        code = EXIT_FAILED
    except Exception as error:
        # A wrong flag.  Typer carries its own click, whose base class it does not export.
        if not hasattr(error, "format_message"):
            raise
        if type(error).__name__ == "NoArgsIsHelpError":
            # No command at all: its message is the whole help.
            print(error.format_message(), file=sys.stderr)
        else:
            print(f"workbench: {' '.join(error.format_message().split())}", file=sys.stderr)
        code = EXIT_USAGE
    # Typer itself takes every interruption for Ctrl-C.
    sys.exit(interrupts.exit_code() if code == EXIT_INTERRUPTED else code)
