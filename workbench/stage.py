"""The contract between the bench and a stage.

A stage is a class that *declares* what it needs, gives and can be turned (artifacts and
parameters) and *does* four things: compute, log, explain a pixel, score against ground truth.
Only :meth:`Stage.compute` is required.  Nothing here imports Rerun, OpenCV or the command line,
so that the workers of a sweep stay light.

Frames and signs, stated once for the whole bench
-------------------------------------------------
* Images are indexed ``[row, column]``; a pixel is written ``(x, y)`` = (column, row); integer
  coordinates are pixel centres.
* ``camera_optical_frame``: origin at the taking lens's centre, +z forward, x right, y down.
* Lengths are metres in artifacts whose name ends in ``_m`` and millimetres where it ends in
  ``_mm``; depth is z along the optical axis, not ray length; unknown depth is NaN.
* ``b_from_a`` maps coordinates of frame *a* to coordinates of frame *b*.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, ClassVar, Literal, Self, get_args, get_origin

import numpy as np
from pydantic import BaseModel, ConfigDict, Field
from pydantic.fields import FieldInfo

from workbench.errors import DataError

Inputs = Mapping[str, Any]
"""What a stage's ``compute`` receives: artifact name to value; an absent optional one is None."""

Outputs = dict[str, Any]
"""What it returns: every artifact it declares, and optionally :data:`WARNINGS`.

A stage may also yield its outputs in parts.  Where it then raises, the parts that it had given
stand, and only the rest is missing: yield first what the other stages can do without the rest of.
"""

WARNINGS = "warnings"
"""Reserved key of :data:`Outputs`: a sequence of sentences about this frame."""


class StageError(DataError):
    """A stage, or the way stages are put together, is wrong: the message says how to mend it."""


# -- artifacts ------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Artifact:
    """A named, typed result that one stage gives and others need.

    ``shape`` names the axes (``"H W"``, ``"N 3"``; empty for a scalar or an object), ``dtype`` is
    a numpy dtype name or ``"object"``.  The host checks both on what a stage returns.
    """

    name: str
    dtype: str = "object"
    shape: str = ""
    unit: str = ""
    doc: str = ""
    required: bool = True
    names_regions: bool = field(default=False, kw_only=True)
    """Whether its integers only name regions, so that renumbering them changes nothing."""

    def optional(self) -> Self:
        """The same artifact as a need that may be absent (its value is then None)."""
        return replace(self, required=False)

    @property
    def axes(self) -> tuple[str, ...]:
        return tuple(self.shape.split())

    def check(self, value: Any, sizes: dict[str, int]) -> None:
        """Raise :class:`StageError` unless ``value`` is what was declared.

        ``sizes`` holds the axis sizes seen so far in this stage's outputs, so that every ``H W``
        of one stage is the same H and W.
        """
        if self.dtype == "object":
            return
        if not isinstance(value, np.ndarray):
            raise StageError(
                f"{self.name}: expected an array {self.dtype} [{self.shape}], "
                f"got {type(value).__name__}"
            )
        if value.dtype != np.dtype(self.dtype):
            raise StageError(f"{self.name}: expected dtype {self.dtype}, got {value.dtype}")
        if value.ndim != len(self.axes):
            raise StageError(f"{self.name}: expected axes [{self.shape}], got shape {value.shape}")
        for axis, size in zip(self.axes, value.shape, strict=True):
            expected = int(axis) if axis.isdigit() else sizes.setdefault(axis, size)
            if expected != size:
                raise StageError(
                    f"{self.name}: axis {axis} should be {expected}, got shape {value.shape}"
                )


@dataclass(frozen=True)
class RecordedImage(Artifact):
    """An image that comes from the recording itself: channel ``near`` is ``/camera/near/image``.

    A channel that is required takes part in pairing: a frame exists where every required
    channel has an image of the same instant.
    """

    channel: str = ""


def recorded_image(channel: str, doc: str = "") -> RecordedImage:
    """The need for the recorded image of ``channel``; its artifact is ``{channel}_image``."""
    return RecordedImage(name=f"{channel}_image", channel=channel, doc=doc)


@dataclass(frozen=True)
class RecordedCamera(Artifact):
    """The intrinsics (:class:`workbench.recording.Camera`) recorded for a channel."""

    channel: str = ""


def recorded_camera(channel: str, doc: str = "") -> RecordedCamera:
    """The need for the recorded intrinsics of ``channel``; its artifact is ``{channel}_camera``."""
    return RecordedCamera(name=f"{channel}_camera", channel=channel, doc=doc)


@dataclass(frozen=True)
class Resource(Artifact):
    """A file beside the recording: a calibration, a model database.

    ``load`` reads it (and raises ``ValueError`` with one line if it cannot); ``make`` names the
    procedure that writes it, as ``module:object``, which ``workbench calibrate`` or
    ``workbench train`` runs: the object has ``Parameters`` and ``run``, and what ``run`` returns
    has ``report`` and ``save(path)``, and for ``train`` ``log(recording)``, which logs it to a
    ``rerun.RecordingStream`` and returns a blueprint.  ``filename`` is what is looked for beside
    a recording.

    Where stages know their optics the object may also have ``rig_record(path, size)``, which reads
    a rig file for images of that size and gives the metadata record ``rig`` and the K of each
    channel, and ``OpticsParameters`` with ``from_optics(rig, size, parameters)``, which makes the
    resource from a rig alone (a file, or that record).  Both raise ``ValueError`` with one line.
    """

    load: Callable[[Path], Any] | None = field(default=None, compare=False)
    make: str = ""
    filename: str = ""


# -- parameters -----------------------------------------------------------------------------------


class StageParameters(BaseModel):
    """The knobs of a stage, declared once with :func:`knob`: frozen, typed, unknown names refused.

    The declaration is the flag, the slider, the sweep axis and the reference page.
    """

    model_config = ConfigDict(frozen=True, extra="forbid", allow_inf_nan=False, strict=True)

    @classmethod
    def knobs(cls) -> dict[str, Knob]:
        """The declarations of this model's parameters, in order."""
        return {name: Knob.of(name, info) for name, info in cls.model_fields.items()}


@dataclass(frozen=True)
class Knob:
    """What is known of one parameter: enough to build a flag, a slider or an axis."""

    name: str
    kind: Literal["int", "float", "bool", "choice", "text"]
    default: Any
    low: float | None
    high: float | None
    step: float | None
    unit: str
    choices: tuple[Any, ...]
    why: str

    @staticmethod
    def of(name: str, info: FieldInfo) -> Knob:
        extra = info.json_schema_extra if isinstance(info.json_schema_extra, dict) else {}
        bounds = {type(m).__name__: m for m in info.metadata}
        low = getattr(bounds.get("Ge"), "ge", None)
        high = getattr(bounds.get("Le"), "le", None)
        choices: tuple[Any, ...] = ()
        kind: Any = "text"
        if get_origin(info.annotation) is Literal:
            kind, choices = "choice", get_args(info.annotation)
        elif info.annotation in (bool, int, float):
            kind = info.annotation.__name__
        step: Any = extra.get("step")
        unit: Any = extra.get("unit", "")
        return Knob(
            name, kind, info.default, low, high, step, unit, choices, info.description or ""
        )


def knob(
    default: Any,
    why: str,
    *,
    low: float | None = None,
    high: float | None = None,
    step: float | None = None,
    unit: str = "",
) -> Any:
    """Declare a parameter of a stage: its default, its range, its unit and why it exists.

    ``why`` is one sentence; ``step`` is what a slider moves by (any value in the range is
    allowed).  Use a ``Literal`` annotation for a choice.
    """
    extra: dict[str, Any] = {"unit": unit}
    if step is not None:
        extra["step"] = step
    return Field(default, description=why, ge=low, le=high, json_schema_extra=extra)


# -- what a stage tells of a pixel and of ground truth ---------------------------------------------


@dataclass(frozen=True)
class Finding:
    """One sentence of a pixel's story: a value, the threshold that it met, and what followed.

    ``values`` are the numbers of the sentence, exactly as they are.  A key that is an artifact
    holds that artifact's value at the pixel, or as a whole where it has no axes ``H W``, so that
    the sentence can be checked.
    ``parameter`` is the knob of the same stage that the value was held against, or that decided.

    ``verdict`` is the state that the pixel is in from here on, in a word or two without numbers
    (``"edge"``, ``"no edge"``): a stage's verdict is its last finding's that has one.  A changed
    verdict is what ``workbench why`` looks for, so two pixels that fare alike have the same.
    ``about`` says what the verdict is on where that is not this very pixel, such as the region
    beside a line: what is asked of a pixel is the last verdict on the pixel itself.
    """

    says: str
    values: Mapping[str, Any] = field(default_factory=dict)
    parameter: str | None = None
    verdict: str = ""
    about: str = ""


Better = Literal["higher", "lower", "zero"]
"""Which values of a figure are better; ``zero`` is for signed ones, such as a bias."""


@dataclass(frozen=True)
class Score:
    """One figure of :meth:`Scorer.summary`: its value, unit, and how much it covers (0..1).

    ``better`` says which way is better, so that a sweep can choose by it; None if neither is.
    ``published`` is what the publication that the stage implements reports for it, in its own
    words; ``evaluate`` sets the two side by side.
    """

    name: str
    value: float
    unit: str = ""
    coverage: float | None = None
    note: str = ""
    better: Better | None = None
    published: str = ""


@dataclass(frozen=True)
class Cut:
    """A threshold that cuts a :class:`Histogram`, and which parameter moves it."""

    name: str
    value: float
    """Where it lies, in the histogram's unit."""
    parameter: str | None = None
    """The stage's parameter that moves it; None where it only follows from others."""
    setting: Callable[[float], Any] | None = None
    """The parameter's value that brings the threshold to a place (or as near as it goes); None
    where the parameter is the place itself."""


@dataclass(frozen=True)
class Histogram:
    """How often each value occurs on this frame, and the thresholds that cut it."""

    name: str
    edges: np.ndarray
    """[N + 1] bin edges, rising, in ``unit``."""
    counts: np.ndarray
    """[N] how many values lie in each bin."""
    cuts: Sequence[Cut]
    unit: str = ""
    log_axis: bool = False
    """Whether the values, all greater than 0, are shown on a logarithmic axis."""


class Scorer:
    """Compares a stage's outputs with ground truth, frame by frame, in bounded memory.

    A scorer whose :meth:`state` and :meth:`take` are implemented can be put together from
    others, each of which saw some of the frames: a sweep scores every frame once, wherever, and
    keeps the state.  Without them a sweep has the means of what :meth:`add` returns.
    """

    def add(self, truth: Any, artifacts: Mapping[str, Any]) -> dict[str, float]:
        """Take one frame in; return its own numbers (they become plots over time)."""
        raise NotImplementedError

    def summary(self) -> list[Score]:
        """The figures over every frame taken in so far."""
        raise NotImplementedError

    def state(self) -> Mapping[str, Any] | None:
        """All that was taken in so far, as numbers, texts, lists, mappings and numpy arrays."""
        return None

    def take(self, state: Mapping[str, Any]) -> None:
        """Take in the :meth:`state` of another scorer of this kind, as if its frames came next."""
        raise NotImplementedError


# -- the stage ------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Logged:
    """What :meth:`Stage.log` may look at: everything known of this frame so far.

    A live page logs a stage again when what it needs, gives or is set to has changed.
    """

    artifacts: Mapping[str, Any]
    parameters: Any
    """The stage's own ``Parameters``."""
    truth: Any = None


class Stage:
    """A plugin from artifacts to artifacts.  The class's docstring is its reference page.

    ``compute`` must be a pure function of its arguments: the host keeps its result under the
    digest of inputs, parameters and code, and makes the arrays read-only.
    """

    name: ClassVar[str]
    needs: ClassVar[Sequence[Artifact]] = ()
    gives: ClassVar[Sequence[Artifact]] = ()
    Parameters: ClassVar[type[StageParameters]] = StageParameters
    chapter: ClassVar[str] = ""
    """Stages of one chapter share a row of the viewer's layout."""
    presets: ClassVar[Mapping[str, Mapping[str, Any]]] = {}
    """Preset name to the parameters in which it differs from the defaults."""
    published_time: ClassVar[str] = ""
    """What the publication that the stage implements says of its time; empty if nothing."""

    def compute(self, inputs: Inputs, parameters: Any) -> Outputs | Iterator[Outputs]:
        """Outputs from inputs and parameters, at once or in parts.

        An exception is caught, shown and counted; parts that were given before it are kept.
        """
        raise NotImplementedError

    def log(self, recording: Any, logged: Logged) -> None:
        """Log this frame's outputs to a ``rerun.RecordingStream`` (import rerun in here)."""

    def views(self, logged: Logged) -> Sequence[Any]:
        """This stage's views, as Rerun blueprint parts, in reading order (import rerun here).

        ``logged`` is the first frame that came through, for what a view must know of the data.
        """
        return ()

    def explain(self, x: int, y: int, artifacts: Mapping[str, Any], p: Any) -> Sequence[Finding]:
        """The story of pixel (x, y) in this stage, in order: values, thresholds, verdict, reason.

        ``artifacts`` is everything known of the frame and ``p`` the stage's own ``Parameters``.
        What is told agrees with the artifacts to the last digit that is printed.
        """
        return ()

    def histograms(self, artifacts: Mapping[str, Any], p: Any) -> Sequence[Histogram]:
        """The distributions that this stage's thresholds cut, for a page where they are moved."""
        return ()

    def scorer(self) -> Scorer | None:
        """A fresh scorer against ground truth, if this stage can be scored."""
        return None

    def figures(self, artifacts: Mapping[str, Any]) -> Sequence[Score]:
        """What can be said of one frame's results without ground truth: shares, counts.

        ``artifacts`` holds everything known of the frame.  A sweep has the means over frames.
        """
        return ()

    def picture(self, artifacts: Mapping[str, Any]) -> np.ndarray | None:
        """This stage's result as one image [H W] or [H W 3] uint8, for a gallery of many runs.

        No Rerun in here: the workers of a sweep draw it.  None leaves it to the bench, which
        shows the last image among what the stage gives.
        """
        return None
