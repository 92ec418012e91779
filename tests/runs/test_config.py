"""Configuration files: what is accepted, and how mistakes are reported."""

import tomllib
from pathlib import Path

import pytest
from pydantic import Field

from vertax.runs import ConfigError, ExperimentConfig, Section, load_config
from vertax.runs._config import all_keys, apply_overrides, template, validate
from vertax.runs._registry import all_experiments

EXPERIMENTS = all_experiments()

CONFIGS = sorted((Path(__file__).parents[2] / "configs").glob("*.toml"))
VALID = 'experiment = "infer_shape_factors"\nseed = 0\n[fit]\nepochs = 7\n'


@pytest.fixture
def write(tmp_path):
    def write(text, name="some.toml"):
        path = tmp_path / name
        path.write_text(text, encoding="utf-8")
        return path

    return write


def refusal(path, *overrides):
    with pytest.raises(ConfigError) as caught:
        load_config(path, overrides)
    return str(caught.value)


@pytest.mark.parametrize("path", CONFIGS, ids=lambda path: path.stem)
def test_every_config_of_the_repository_is_valid(path):
    load_config(path)


def test_keys_left_out_have_their_defaults(write):
    experiment, config = load_config(write(VALID))
    assert experiment is EXPERIMENTS["infer_shape_factors"]
    assert config.fit.epochs == 7
    assert config.fit.learning_rate == type(config)().fit.learning_rate


@pytest.mark.parametrize(
    ("override", "get", "expected"),
    [
        ("fit.epochs=50", lambda c: c.fit.epochs, 50),
        ("relaxation.contacts=false", lambda c: c.relaxation.build().contact_range, None),
        ("fit.learning_rate=1", lambda c: c.fit.learning_rate, 1.0),
        (" fit . optimiser = nadam ", lambda c: c.fit.optimiser, "nadam"),
        ('data="image"', lambda c: c.data, "image"),
        ("relaxation.transitions=false", lambda c: c.relaxation.transitions, False),
        ("fit={epochs=3}", lambda c: c.fit.epochs, 3),
    ],
)
def test_an_override_sets_one_key(write, override, get, expected):
    assert get(load_config(write(VALID), [override])[1]) == expected


def test_overrides_leave_the_original_alone_and_cannot_add_keys():
    data = {"a": {"b": 1}}
    text = "1\nc = 2"
    assert apply_overrides(data, ["a.b=2", "d.e=x y", f"f={text}"]) == {
        "a": {"b": 2},
        "d": {"e": "x y"},
        "f": text,
    }
    assert data == {"a": {"b": 1}}


@pytest.mark.parametrize(
    ("override", "message"),
    [
        ("fit.epochs", "must have the form key=value, as in fit.epochs=50, but is 'fit.epochs'."),
        ("fit.=3", "must have the form key=value"),
        (
            "seed.x=1",
            "Cannot set `seed.x`: `seed` is 0 and not a table. Set either `seed` or its keys.",
        ),
        ("tissue.n_cell=3", "there is no key `tissue.n_cell`; did you mean `tissue.n_cells`?"),
        ("epochs=3", "there is no key `epochs`; did you mean `fit.epochs`?"),
        ("fits.epochs=1", "there is no key `fits`; did you mean `fit`?"),
        ("fit.xyz=1", "allowed are: `fit.optimiser`, `fit.learning_rate`, `fit.epochs`."),
        (f"data={'a' * 10_000}", 'but is "' + "a" * 79 + "…."),
        ("fit.epochs=many", '`fit.epochs` must be a valid integer, but is "many".'),
        ("fit.epochs=2.5", "`fit.epochs` must be a valid integer, but is 2.5."),
        ("fit.epochs=true", "`fit.epochs` must be a valid integer, but is true."),
        ("fit.epochs=0", "`fit.epochs` must be greater than or equal to 1, but is 0."),
        ("fit.learning_rate=nan", "`fit.learning_rate` must be a finite number, but is NaN."),
        ("image.uneven_gain=1", "`image.uneven_gain` must be less than 1, but is 1."),
        ("relaxation.transitions=1", "`relaxation.transitions` must be a valid boolean, but is 1."),
        ("relaxation.tolerance=-1", "`relaxation.tolerance` must be greater than 0, but is -1."),
        ("data=pixels", "`data` must be 'vertices', 'image' or 'both', but is \"pixels\"."),
        ("tissue=20", "`tissue` must be a table, but is 20."),
        ("seed={a=1}", "`seed` must be a valid integer, but is { a = 1 }."),
    ],
)
def test_a_wrong_key_or_value_is_an_error_with_a_remedy(write, override, message):
    assert message in refusal(write(VALID), override)


def test_all_mistakes_are_reported_at_once_with_the_file(write):
    path = write(VALID)
    message = refusal(path, "fit.epochs=0", "seeds=1", "data=3")
    assert message.startswith(f"In {path}:")
    assert all(part in message for part in ("`fit.epochs`", "`seeds`", "`data`"))


def test_a_missing_file_and_bad_toml_are_named(write, tmp_path):
    assert f"no configuration file {tmp_path / 'none.toml'}" in refusal(tmp_path / "none.toml")
    assert f"Cannot read {tmp_path}" in refusal(tmp_path)
    bad = write("fit = [", "bad.toml")
    assert f"{bad} is not valid TOML" in refusal(bad)
    deep = write("x = " + "[" * 5000, "deep.toml")
    assert refusal(deep) == f"{deep} is nested too deeply."
    binary = tmp_path / "binary.toml"
    binary.write_bytes(b"\xff\xfe\x00")
    assert f"{binary} is not valid TOML" in refusal(binary)


def test_a_byte_order_mark_is_no_mistake(tmp_path):
    path = tmp_path / "windows.toml"
    path.write_bytes(b"\xef\xbb\xbf" + VALID.replace("\n", "\r\n").encode())
    assert load_config(path)[1].fit.epochs == 7


def test_the_experiment_must_be_named_and_exist(write):
    assert "`experiment` is missing" in refusal(write("seed = 1"))
    message = refusal(write('experiment = "infer_shape_factor"'))
    assert "did you mean 'infer_shape_factors'?" in message
    assert "there are: design_mechanics" in refusal(write("experiment = 3"))


@pytest.mark.parametrize("experiment", EXPERIMENTS.values(), ids=lambda e: e.name)
def test_the_template_is_a_configuration_with_all_defaults_explained(experiment):
    text = template(experiment.config, experiment.name)
    assert validate(experiment.config, tomllib.loads(text)) == experiment.config()
    for key in all_keys(experiment.config):
        assert f"{key.rpartition('.')[2]} =" in text or f"[{key}]  # " in text
    assert "#  (" not in text  # a comment without a description


class _Camera(Section):
    """A table."""

    path: Path = Field(strict=False)
    """Where it is."""
    crop: list[int] = Field(default=[0, 0])
    """Corner."""


class _Config(ExperimentConfig):
    """A configuration."""

    camera: _Camera
    """A camera."""


class _Deep(ExperimentConfig):
    """A configuration with its own defaults for shared tables."""

    outer: "_Outer" = Field(default_factory=lambda: _Outer())
    """A table."""
    camera: _Camera = _Camera(path=Path("here.tif"), crop=[1, 2])
    """A camera."""


class _Inner(Section):
    """A table in a table."""

    a: int = 1
    """A."""
    b: int = 2
    """B."""


class _Outer(Section):
    """A table."""

    inner: _Inner = _Inner(a=10)
    """The inner one."""


_Deep.model_rebuild()


def test_a_table_of_which_one_key_is_given_keeps_the_defaults_of_the_others():
    assert validate(_Deep, {"camera": {"crop": [3, 4]}}).camera.path == Path("here.tif")
    inner = validate(_Deep, {"outer": {"inner": {"b": 5}}}).outer.inner
    assert (inner.a, inner.b) == (10, 5)
    assert "a = 10" in template(_Deep, "x")
    with pytest.raises(ConfigError, match=r"`camera` must be a table"):
        validate(_Deep, {"camera": 3})
    with pytest.raises(ConfigError, match=r"no key `outer.inner.aa`"):
        validate(_Deep, {"outer": {"inner": {"aa": 5}}})


@pytest.mark.parametrize("experiment", EXPERIMENTS.values(), ids=lambda e: e.name)
def test_setting_a_default_changes_nothing(experiment):
    default = experiment.config().model_dump(exclude_none=True)
    for table, keys in default.items():
        for key, value in keys.items() if isinstance(keys, dict) else ():
            assert validate(experiment.config, {table: {key: value}}) == experiment.config()


def test_missing_keys_paths_and_lists_are_explained():
    for data, message in (
        ({}, "`camera` is missing."),
        ({"camera": {}}, "`camera.path` is missing."),
        ({"camera": {"path": "a", "crop": [1, 2.5]}}, "`camera.crop.1` must be a valid integer"),
    ):
        with pytest.raises(ConfigError, match=message):
            validate(_Config, data)
    assert validate(_Config, {"camera": {"path": "a.tif"}}).camera.path == Path("a.tif")
    assert "path =\n" in template(_Config, "x")
