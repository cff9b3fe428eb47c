"""Parameters are laid over one another in order, and what is wrong is told in one line."""

from __future__ import annotations

import tomllib
from collections.abc import Mapping
from pathlib import Path
from typing import Any, Literal

import pytest

from workbench.plugins import find_stages
from workbench.settings import (
    Settings,
    SettingsError,
    adjusted,
    preset_names,
    reason_in,
    resolve,
    to_toml,
    value_from_text,
)
from workbench.stage import Knob, Stage, StageParameters, knob


class Blur(Stage):
    name = "blur"

    class Parameters(StageParameters):
        sigma: float = knob(1.0, "How wide.", low=0, high=10, step=0.5, unit="px")
        rounds: int = knob(1, "How often.", low=1, high=6, step=1, unit="rounds")
        kind: Literal["box", "gauss"] = knob("gauss", "Which window.")
        wrap: bool = knob(False, "Around the border.")
        label: str = knob("", "A name.")

    presets = {"soft": {"sigma": 4.0, "rounds": 2}}


class Cut(Stage):
    name = "cut"

    class Parameters(StageParameters):
        level: float = knob(0.5, "Where.", low=0, high=1, step=0.1)

    presets = {"soft": {"level": 0.25}, "hard": {"level": 1.0}}


STAGES: Mapping[str, Stage] = {"blur": Blur(), "cut": Cut()}
BUILT_IN = find_stages()


def flat(settings: Settings) -> dict[str, Any]:
    return {f"{s}.{k}": v for s, values in settings.as_dict().items() for k, v in values.items()}


def toml(folder: Path, text: str) -> Path:
    path = folder / "tuned.toml"
    path.write_text(text, encoding="utf-8")
    return path


TUNED = 'preset = "soft"\n[parameters.blur]\nrounds = 3\nkind = "box"\n'


def test_defaults_then_preset_then_config_then_set(tmp_path: Path) -> None:
    found = flat(resolve(STAGES, None, toml(tmp_path, TUNED), ["blur.kind=gauss"]))
    assert found["blur.wrap"] is False
    assert found["blur.sigma"] == 4.0 and found["cut.level"] == 0.25
    assert found["blur.rounds"] == 3
    assert found["blur.kind"] == "gauss"


def test_a_preset_that_is_asked_for_overrides_the_files(tmp_path: Path) -> None:
    settings = resolve(STAGES, "hard", toml(tmp_path, TUNED))
    assert settings.preset == "hard"
    assert flat(settings)["blur.sigma"] == 1.0 and flat(settings)["blur.rounds"] == 3


def test_the_last_set_wins() -> None:
    assert flat(resolve(STAGES, assignments=["cut.level=0.1", "cut.level=0.2"]))["cut.level"] == 0.2


@pytest.mark.parametrize(
    "form", ["[parameters]\n'cut.level' = 0.75", "[parameters.cut]\nlevel=.75"]
)
def test_a_config_may_name_parameters_by_table_or_by_address(tmp_path: Path, form: str) -> None:
    form = form.replace("=.75", "=0.75")
    assert flat(resolve(STAGES, config=toml(tmp_path, form)))["cut.level"] == 0.75


@pytest.mark.parametrize(
    ("text", "value"),
    [("blur.sigma=2", 2.0), ("blur.sigma = 2.5", 2.5), ("blur.wrap=true", True),
     ("blur.kind=box", "box"), ('blur.kind="box"', "box"), ("blur.label=a=b", "a=b"),
     ("blur.sigma=1e-3", 1e-3)],
)  # fmt: skip
def test_set_takes_numbers_switches_and_words(text: str, value: Any) -> None:
    address = text.partition("=")[0].strip()
    assert flat(resolve(STAGES, assignments=[text]))[address] == value


@pytest.mark.parametrize("preset", ["default", "soft", "hard"])
@pytest.mark.parametrize(
    "sets", [[], ["blur.rounds=2"], ["cut.level=0.25", "blur.sigma=4"], ["blur.label=x"]]
)
def test_changed_is_exactly_what_differs_from_the_preset(preset: str, sets: list[str]) -> None:
    plain, settings = resolve(STAGES, preset), resolve(STAGES, preset, assignments=sets)
    before, after = flat(plain), flat(settings)
    assert plain.changed == {}
    assert settings.changed == {k: v for k, v in after.items() if v != before[k]}


def test_what_changed_repeats_the_run(tmp_path: Path) -> None:
    tuned = resolve(STAGES, None, toml(tmp_path, TUNED), ["cut.level=0.9"])
    again = resolve(STAGES, tuned.preset, None, [f"{k}={v}" for k, v in tuned.changed.items()])
    assert flat(again) == flat(tuned) and again.changed == tuned.changed


def test_adjusting_is_the_same_as_setting() -> None:
    soft = resolve(STAGES, "soft")
    turned = adjusted(STAGES, soft, {"blur.rounds": 3, "cut.level": 1})
    assert turned == resolve(STAGES, "soft", assignments=["blur.rounds=3", "cut.level=1"])
    assert adjusted(STAGES, turned, {"blur.rounds": 2, "cut.level": 0.25}) == soft


@pytest.mark.parametrize(
    ("address", "value"), [("blur.rounds", 7), ("blur.rounds", "3"), ("blur.no", 1), ("no.x", 1)]
)
def test_adjusting_refuses_what_setting_refuses(address: str, value: Any) -> None:
    with pytest.raises(SettingsError, match=address.split(".")[0]):
        adjusted(STAGES, resolve(STAGES), {address: value})


@pytest.mark.parametrize("preset", ["default", "soft"])
def test_a_written_configuration_reads_back_to_the_same_settings(
    tmp_path: Path, preset: str
) -> None:
    settings = adjusted(
        STAGES,
        resolve(STAGES, preset),
        {"blur.sigma": 0.1, "blur.label": 'a "quoted"\nname', "blur.wrap": True},
    )
    text = to_toml(settings, "dark parts", {"frames": [0, None], "until": None, "bench": "1"})
    assert resolve(STAGES, None, toml(tmp_path, text)) == settings


def test_parameters_are_frozen() -> None:
    parameters = resolve(STAGES).parameters["cut"]
    with pytest.raises(ValueError, match="frozen"):
        parameters.level = 0.1  # type: ignore[attr-defined]


@pytest.mark.parametrize(
    ("text", "named"),
    [
        ("nothing.sigma=1", ["nothing", "blur, cut"]),
        ("blur.nothing=1", ["blur", "nothing", "sigma"]),
        ("blur=1", ["blur", "sigma"]),
        ("blur.sigma", ["blur.sigma", "="]),
        ("=1", ["=1"]),
        ("blur.sigma=11", ["blur.sigma", "10", "11"]),
        ("blur.sigma=-0.1", ["blur.sigma", "0", "-0.1"]),
        ("blur.sigma=wide", ["blur.sigma", "number", "wide"]),
        ("blur.sigma=", ["blur.sigma"]),
        ("blur.sigma=nan", ["blur.sigma", "nan"]),
        ("blur.sigma=inf", ["blur.sigma", "inf"]),
        ("blur.sigma=[1]", ["blur.sigma", "[1]"]),
        ("blur.sigma=true", ["blur.sigma", "True"]),
        ("blur.rounds=1.5", ["blur.rounds", "integer", "1.5"]),
        ("blur.rounds=true", ["blur.rounds", "True"]),
        ("blur.kind=round", ["blur.kind", "box", "gauss", "round"]),
        ("blur.wrap=perhaps", ["blur.wrap", "perhaps"]),
        ("blur.sigma=1\n2", ["blur.sigma"]),
    ],
)
def test_a_wrong_assignment_is_told_in_one_line(text: str, named: list[str]) -> None:
    with pytest.raises(SettingsError) as told:
        resolve(STAGES, assignments=[text])
    says = str(told.value)
    assert all(name in says for name in named), says
    assert "\n" not in says


@pytest.mark.parametrize(
    ("text", "named"),
    [
        ("parameters = 3", ["parameters"]),
        ("[parameters.nothing]\nx = 1", ["nothing", "blur, cut"]),
        ("[parameters.blur]\nnothing = 1", ["nothing", "sigma"]),
        ("[parameters.blur]\nsigma = 11", ["blur.sigma", "11"]),
        ("[parameters.blur]\nsigma = nan", ["blur.sigma", "nan"]),
        ("[parameters.blur.sigma]\nx = 1", ["blur.sigma"]),
        ("[parameters]\nblur = 1", ["blur"]),
        ('preset = "nothing"', ["nothing", "soft"]),
        ("preset = 3", ["preset", "3"]),
        ("sigma = = 1", ["tuned.toml", "TOML"]),
        ("[parameter.blur]\nsigma = 2", ["tuned.toml", "parameter"]),
        ("[blur]\nsigma = 2", ["tuned.toml", "blur"]),
    ],
)
def test_a_wrong_config_is_told_in_one_line(tmp_path: Path, text: str, named: list[str]) -> None:
    with pytest.raises(SettingsError) as told:
        resolve(STAGES, config=toml(tmp_path, text))
    says = str(told.value)
    assert all(name in says for name in named), says
    assert "\n" not in says


def test_a_config_that_is_not_there_or_not_text_is_told_in_one_line(tmp_path: Path) -> None:
    binary = tmp_path / "binary.toml"
    binary.write_bytes(b"\xff\xfe\x00")
    for path in (tmp_path / "nothing.toml", tmp_path, binary):
        with pytest.raises(SettingsError) as told:
            resolve(STAGES, config=path)
        assert str(path) in str(told.value) and "\n" not in str(told.value)


def test_an_unknown_preset_is_told_with_those_that_there_are() -> None:
    with pytest.raises(SettingsError, match=r"nothing.*default, hard, soft"):
        resolve(STAGES, "nothing")


# -- the declarations of the stages that come with the bench --------------------------------------

KNOBS = [
    pytest.param(knob_, id=f"{one.name}.{knob_.name}")
    for one in BUILT_IN.values()
    for knob_ in one.Parameters.knobs().values()
]


@pytest.mark.parametrize("declared", KNOBS)
def test_every_knob_says_why_and_is_within_its_own_range(declared: Knob) -> None:
    assert declared.why.endswith(".") and declared.why[0].isupper() and "\n" not in declared.why
    if declared.kind in ("int", "float"):
        assert declared.low is not None and declared.high is not None and declared.step
        assert declared.low <= declared.default <= declared.high
        assert 0 < declared.step <= declared.high - declared.low
        # A share between 0 and 1 has no unit; everything else that is a number has.
        assert declared.unit or (declared.low, declared.high) == (0, 1)
    elif declared.kind == "choice":
        assert len(declared.choices) > 1 and declared.default in declared.choices
    elif declared.kind == "bool":
        assert isinstance(declared.default, bool)


@pytest.mark.parametrize("preset", preset_names(BUILT_IN.values()))
def test_every_preset_is_valid(preset: str) -> None:
    assert resolve(BUILT_IN, preset).changed == {}


@pytest.mark.parametrize("one", list(BUILT_IN.values()), ids=list(BUILT_IN))
def test_every_stage_and_artifact_has_words(one: Stage) -> None:
    assert (type(one).__doc__ or "").strip()
    for artifact in (*one.needs, *one.gives):
        assert artifact.doc, artifact.name
    for artifact in one.gives:
        if artifact.name.endswith(("_m", "_mm", "_px", "_deg")) and artifact.dtype != "object":
            assert artifact.unit == artifact.name.rpartition("_")[2]


# -- what is remembered of presets ----------------------------------------------------------------


def test_two_classes_of_one_name_have_presets_of_their_own() -> None:
    def blur(sigma: float) -> Stage:
        class Parameters(StageParameters):
            sigma: float = knob(1.0, "How wide.", low=0, high=10)

        members = {
            "name": "blur", "Parameters": Parameters, "presets": {"soft": {"sigma": sigma}},
        }  # fmt: skip
        made: Stage = type("Blur", (Stage,), members)()
        return made

    for one in (blur(2.0), blur(3.0), blur(2.0)):
        soft = resolve({"blur": one}, "soft")
        own = type(one).presets["soft"]["sigma"]
        assert flat(soft) == {"blur.sigma": own} and soft.changed == {}
        tuned = resolve({"blur": one}, "soft", assignments=["blur.sigma=2.5"])
        assert tuned.changed == {"blur.sigma": 2.5}
        assert resolve({"blur": one}, "soft", assignments=[f"blur.sigma={own}"]).changed == {}


def test_a_stage_without_a_preset_of_that_name_keeps_its_defaults() -> None:
    hard = resolve(STAGES, "hard")
    assert flat(hard)["blur.sigma"] == 1.0 and flat(hard)["cut.level"] == 1.0
    assert hard.changed == {}


def test_the_presets_of_all_stages_are_named_once_the_default_first() -> None:
    assert preset_names(STAGES.values()) == ["default", "hard", "soft"]
    assert preset_names([]) == ["default"]

    class Own(Cut):
        presets = {"default": {"level": 0.1}, "able": {}}

    assert preset_names([Own()]) == ["default", "able"]
    assert flat(resolve({"cut": Own()}))["cut.level"] == 0.1


def test_adjusting_several_parameters_of_a_stage_at_once_and_leaving_the_others() -> None:
    tuned = adjusted(
        STAGES, resolve(STAGES, "soft", assignments=["blur.kind=box"]),
        {"blur.rounds": 3, "blur.sigma": 5.0},
    )  # fmt: skip
    assert flat(tuned) == flat(resolve(STAGES, "soft")) | {
        "blur.kind": "box", "blur.rounds": 3, "blur.sigma": 5.0
    }  # fmt: skip
    assert tuned.preset == "soft"
    assert tuned.changed == {"blur.kind": "box", "blur.rounds": 3, "blur.sigma": 5.0}


def test_a_written_configuration_holds_what_was_changed_the_reason_and_nothing_more(
    tmp_path: Path,
) -> None:
    settings = resolve(STAGES, "soft", assignments=["cut.level=0.5", "blur.wrap=true"])
    path = toml(tmp_path, to_toml(settings, "dark parts", {"a": None, "b": {"c": [1, None]}}))
    assert tomllib.loads(path.read_text()) == {
        "preset": "soft",
        "reason": "dark parts",
        "parameters": {"cut": {"level": 0.5}, "blur": {"wrap": True}},
        "provenance": {"b": {"c": [1]}},
    }
    assert reason_in(path) == "dark parts"
    plain = toml(tmp_path, to_toml(settings))
    assert tomllib.loads(plain.read_text()).keys() == {"preset", "parameters"}
    assert reason_in(plain) == ""


@pytest.mark.parametrize(
    ("text", "value"),
    [("2", 2), ("2.0", 2.0), ("true", True), ("[1, 2]", [1, 2]), ("word", "word"),
     ("'1'", "1"), ("", ""), ("a b", "a b"), ("1,2", "1,2")],
)  # fmt: skip
def test_a_text_is_the_value_that_it_looks_like(text: str, value: Any) -> None:
    found = value_from_text(text)
    assert found == value and type(found) is type(value)


@pytest.mark.parametrize(
    ("name", "kind", "low", "high", "step", "unit", "choices"),
    [
        ("sigma", "float", 0, 10, 0.5, "px", ()),
        ("rounds", "int", 1, 6, 1, "rounds", ()),
        ("kind", "choice", None, None, None, "", ("box", "gauss")),
        ("wrap", "bool", None, None, None, "", ()),
        ("label", "text", None, None, None, "", ()),
    ],
)
def test_a_knob_says_all_of_its_declaration(
    name: str, kind: str, low: Any, high: Any, step: Any, unit: str, choices: tuple[str, ...]
) -> None:
    declared = Blur.Parameters.knobs()[name]
    assert (declared.name, declared.kind, declared.low, declared.high) == (name, kind, low, high)
    assert (declared.step, declared.unit, declared.choices) == (step, unit, choices)
    assert declared.default == getattr(Blur.Parameters(), name) and declared.why.endswith(".")


@pytest.mark.parametrize(("value", "fits"), [(0, True), (10, True), (-0.001, False),
                                             (10.001, False)])  # fmt: skip
def test_the_ends_of_a_range_belong_to_it(value: float, fits: bool) -> None:
    if fits:
        assert flat(resolve(STAGES, assignments=[f"blur.sigma={value}"]))["blur.sigma"] == value
    else:
        with pytest.raises(SettingsError, match=r"blur\.sigma"):
            resolve(STAGES, assignments=[f"blur.sigma={value}"])
