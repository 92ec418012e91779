"""Typed configurations: common keys, reading, and error messages."""

from __future__ import annotations

import difflib
import functools
import os
import tomllib
import types
from collections.abc import Iterable, Iterator, Mapping
from pathlib import Path
from typing import Any, Literal, TypeVar, Union, get_args, get_origin

from vertax._base.extras import requires_extra
from vertax.runs._errors import ConfigError

with requires_extra("run", "The configuration of experiments"):
    import annotated_types
    import pydantic
    from pydantic.fields import FieldInfo


class Section(pydantic.BaseModel):
    """A table of a configuration file.

    Subclass it; each key is a field with a type, a default and a docstring below. Unknown keys and
    values of another type are refused (an integer counts as a number, nothing else is converted).
    """

    model_config = pydantic.ConfigDict(
        extra="forbid",
        strict=True,
        frozen=True,
        allow_inf_nan=False,
        use_attribute_docstrings=True,
    )

    # An experiment may change the defaults of a shared table, `fit: Fitting = Fitting(epochs=150)`.
    # They apply to each key of the table, also if the configuration sets another key of it.
    @pydantic.model_validator(mode="before")
    @classmethod
    def _complete(cls, data: Any) -> Any:
        if not isinstance(data, Mapping):
            return data
        defaults = {name: field.default for name, field in cls.model_fields.items()}
        return {
            name: _merge(default.model_dump(), value)
            if isinstance(default := defaults.get(name), Section)
            else value
            for name, value in data.items()
        }


class ExperimentConfig(Section):
    """The keys of all jobs and experiments; subclasses add others."""

    experiment: str = ""
    """The job or experiment to run: the name of its module."""
    seed: int = pydantic.Field(default=0, ge=0)
    """Seed of everything random."""
    precision: Literal["float64", "float32"] = "float64"
    """Precision of floating-point numbers."""

    @pydantic.model_validator(mode="after")
    def _seed_that_is_kept(self) -> Any:
        # JAX silently drops all but the lower 32 bits.
        if self.precision == "float32" and self.seed >= 2**32:
            raise ValueError(
                f"with precision float32, `seed` must be below 2**32, but is {self.seed}"
            )
        return self


@functools.cache
def named(config: type[ExperimentConfig], name: str) -> type[ExperimentConfig]:
    """A configuration class with a key `experiment` that accepts one name only.

    **Arguments:**

    - `config`: the class with the keys of the job or experiment.
    - `name`: the name.

    **Returns:** a subclass.
    """
    key = pydantic.Field(name, description=config.model_fields["experiment"].description)
    fields: dict[str, Any] = {"experiment": (Literal[name], key)}
    return pydantic.create_model(
        config.__name__, __base__=config, __module__=config.__module__, **fields
    )


Model = TypeVar("Model", bound=Section)


def read_toml(path: str | os.PathLike[str]) -> dict[str, Any]:
    """Read a TOML file.

    **Arguments:**

    - `path`: the file.

    **Returns:** its content.

    **Raises:**

    - `ConfigError`, naming the file, if it cannot be read or is not valid TOML.
    """
    try:
        # Editors on Windows write a byte-order mark.
        return tomllib.loads(Path(path).read_text(encoding="utf-8-sig"))
    except FileNotFoundError:
        raise ConfigError(f"There is no configuration file {os.fspath(path)}.") from None
    except OSError as error:
        raise ConfigError(f"Cannot read {os.fspath(path)}: {error.strerror}.") from error
    except ValueError as error:  # of TOML, of text that is not UTF-8, or of a name that is no path
        raise ConfigError(f"{os.fspath(path)} is not valid TOML: {error}.") from error
    except RecursionError:
        raise ConfigError(f"{os.fspath(path)} is nested too deeply.") from None


def apply_overrides(data: Mapping[str, Any], overrides: Iterable[str]) -> dict[str, Any]:
    """Set single keys of a configuration.

    **Arguments:**

    - `data`: the configuration; left as it is.
    - `overrides`: texts `key=value` with a dotted key, e.g. `"fit.epochs=50"`. The value is written
        as in TOML; what is not valid TOML is taken as a string, so plain words need no quotes. A
        later one wins.

    **Returns:** a new configuration.

    **Raises:**

    - `ConfigError` for a text without `=`, an empty key or value, or a key inside what is no table.
    """
    config = _copy(data)
    for override in overrides:
        key, equals, text = override.partition("=")
        parts = [part.strip() for part in key.split(".")]
        if not equals or not all(parts):
            raise ConfigError(
                f"An override must have the form key=value, as in fit.epochs=50, but is "
                f"{override!r}."
            )
        if not text.strip():
            raise ConfigError(
                f"An override must have a value, but {override!r} has none: is a variable unset? An empty "
                f"text is {key}='\"\"'."
            )
        table = config
        for depth, part in enumerate(parts[:-1], start=1):
            table = table.setdefault(part, {})
            if not isinstance(table, dict):
                raise ConfigError(
                    f"Cannot set `{'.'.join(parts)}`: `{'.'.join(parts[:depth])}` is a value and "
                    "not a table."
                )
        table[parts[-1]] = _parse(text)
    return config


def validate(
    model: type[Model], data: Mapping[str, Any], where: str = "the configuration"
) -> Model:
    """Check a configuration against its model.

    **Arguments:**

    - `model`: the class to make.
    - `data`: the configuration.
    - `where`: what it is called in messages, e.g. the name of the file.

    **Returns:** an instance of `model`.

    **Raises:**

    - `ConfigError` that lists every unknown, missing or ill-typed key by its full dotted name, with
        what is allowed there and, for an unknown one, the nearest key that exists.
    """
    too_large = [
        f"`{key}` is {value}, which is no integer of 64 bits, as TOML has them."
        for key, value in _flat(data)
        if isinstance(value, int) and not -(2**63) <= value < 2**63
    ]
    if too_large:
        raise ConfigError(f"In {where}: {' '.join(too_large)}")
    try:
        return model.model_validate(dict(data))
    except pydantic.ValidationError as error:
        keys = fields(model)
        lines = [_explain(keys, mistake) for mistake in error.errors(include_url=False)]
        listed = "\n  ".join(["", *lines]) if len(lines) > 1 else f" {lines[0]}"
        raise ConfigError(f"In {where}:{listed}") from None


def fields(model: type[Section], prefix: str = "") -> dict[str, FieldInfo]:
    """All keys of a configuration by their dotted names; a table comes before the keys in it.

    **Arguments:**

    - `model`: the class of the configuration.
    - `prefix`: put before each name.

    **Returns:** the Pydantic field of each key.
    """
    keys: dict[str, FieldInfo] = {}
    for name, field in model.model_fields.items():
        keys[prefix + name] = field
        if (section := _section(field)) is not None:
            keys |= fields(section, f"{prefix}{name}.")
    return keys


def template(model: type[ExperimentConfig], name: str) -> str:
    """A configuration file with every key at its default, each explained in a comment.

    **Arguments:**

    - `model`: the class of the configuration.
    - `name`: of the experiment.

    **Returns:** the text of a TOML file.
    """
    lines = [f'experiment = "{name}"', *_template_lines(model, "", {})]
    return "\n".join(lines) + "\n"


def allowed(field: FieldInfo) -> str:
    """What may be written at a key, in words.

    **Arguments:**

    - `field`: the field of the key, see `fields`.

    **Returns:** e.g. `"an integer, at least 1"`.
    """
    words = {
        annotated_types.Ge: ("ge", "at least {}"),
        annotated_types.Gt: ("gt", "above {}"),
        annotated_types.Le: ("le", "at most {}"),
        annotated_types.Lt: ("lt", "below {}"),
    }
    bounds = [
        words[type(mark)][1].format(getattr(mark, words[type(mark)][0]))
        for mark in field.metadata
        if type(mark) in words
    ]
    return ", ".join([_type_in_words(field.annotation), *bounds])


_TYPES = {int: "an integer", float: "a number", str: "a string", bool: "true or false"}


def _type_in_words(annotation: Any) -> str:
    origin, arguments = get_origin(annotation), get_args(annotation)
    if origin in (Union, types.UnionType):
        return " or ".join(_type_in_words(a) for a in arguments if a is not types.NoneType)
    if origin is Literal:
        return "one of " + ", ".join(_in_toml(value) for value in arguments)
    if origin in (list, tuple):
        return f"a list, each entry {_type_in_words(arguments[0])}"
    if isinstance(annotation, type) and issubclass(annotation, Section):
        return f"a table with the keys {', '.join(annotation.model_fields)}"
    if isinstance(annotation, type) and issubclass(annotation, Path):
        return "a string, the path of a file"
    return _TYPES.get(annotation, str(annotation))


def _explain(keys: Mapping[str, FieldInfo], mistake: Any) -> str:
    """One mistake, as Pydantic reports it, in a sentence."""
    name = ".".join(str(part) for part in mistake["loc"])
    # An entry of a list is judged by the field that the list belongs to.
    field = keys.get(".".join(part for part in mistake["loc"] if isinstance(part, str)))
    if mistake["type"] == "extra_forbidden":
        near = _nearest(name, keys)
        if near is not None:
            return f"there is no key `{name}`; did you mean `{near}` ({allowed(keys[near])})?"
        parent, _, _ = name.rpartition(".")
        siblings = [key for key in keys if key.rpartition(".")[0] == parent]
        return f"there is no key `{name}`; allowed are: {', '.join(f'`{k}`' for k in siblings)}."
    if mistake["type"] == "missing" and field is not None:
        return f"`{name}` is missing; it must be {allowed(field)}."
    if mistake["type"] == "value_error" or field is None:  # of a validator of ours
        what = str(mistake.get("ctx", {}).get("error", mistake["msg"])).removesuffix(".")
        return f"`{name}`: {what}." if name else f"{what}."
    return f"`{name}` must be {allowed(field)}, but is {_in_toml(mistake['input'])}."


def _nearest(name: str, keys: Iterable[str]) -> str | None:
    """The most similar key, also in another table."""
    alike = lambda a, b: difflib.SequenceMatcher(None, a, b).ratio()
    last = lambda key: key.rpartition(".")[2]
    score = lambda key: alike(last(key), last(name)) + 0.5 * alike(key, name)
    best = max(keys, key=score, default=None)
    return best if best is not None and alike(last(best), last(name)) > 0.65 else None


def _template_lines(
    model: type[Section], prefix: str, defaults: Mapping[str, Any]
) -> Iterator[str]:
    sections: list[tuple[str, type[Section], FieldInfo]] = []
    for name, field in model.model_fields.items():
        section = _section(field)
        if section is not None:
            sections.append((f"{prefix}{name}", section, field))
        elif name != "experiment":
            yield f"# {_one_line(field.description)} ({allowed(field)})"
            default = defaults.get(name, field.get_default(call_default_factory=True))
            if field.is_required() and name not in defaults:
                yield f"{name} ="
            elif default is None:
                yield f"# {name} ="
            else:
                yield f"{name} = {_in_toml(default)}"
    for name, section, field in sections:
        yield ""
        yield f"[{name}]  # {_one_line(field.description)}"
        below = field.default.model_dump() if isinstance(field.default, Section) else {}
        inherited = defaults.get(name.rpartition(".")[2])
        yield from _template_lines(section, f"{name}.", inherited or below)


def _section(field: FieldInfo) -> type[Section] | None:
    kind: Any = field.annotation
    return kind if isinstance(kind, type) and issubclass(kind, Section) else None


def _one_line(text: str | None) -> str:
    return " ".join((text or "").split())


def _parse(text: str) -> Any:
    try:
        table = tomllib.loads(f"value = {text}")
    except ValueError:  # no TOML, or a number of thousands of digits
        return text.strip()
    except RecursionError:
        raise ConfigError(f"The value {text[:20]}… is nested too deeply.") from None
    # A text with line breaks could smuggle in more keys.
    return table["value"] if table.keys() == {"value"} else text.strip()


def _merge(below: Mapping[str, Any], above: Any) -> Any:
    """Two nested tables as one; what stands above wins."""
    if not isinstance(above, Mapping):
        return above
    merge = lambda name: (
        _merge(below[name], above[name]) if isinstance(below.get(name), Mapping) else above[name]
    )
    return {**below, **{name: merge(name) for name in above}}


def _flat(data: Any, name: str = "") -> Iterator[tuple[str, Any]]:
    """All single values with their dotted names."""
    if isinstance(data, Mapping | list):
        for key, value in data.items() if isinstance(data, Mapping) else enumerate(data):
            yield from _flat(value, f"{name}.{key}" if name else str(key))
    else:
        yield name, data


def _copy(data: Any) -> Any:
    return {key: _copy(value) for key, value in data.items()} if isinstance(data, Mapping) else data


def _in_toml(value: Any) -> str:
    if isinstance(value, Section):
        entries = [f"{name} = {_in_toml(entry)}" for name, entry in value.model_dump().items()]
        return f"{{ {', '.join(entries)} }}"
    if isinstance(value, Mapping):
        return "a table"
    if isinstance(value, bool):
        return str(value).lower()
    if isinstance(value, list | tuple):
        return f"[{', '.join(map(_in_toml, value))}]"
    if isinstance(value, str | Path):
        text = str(value)
        return f'"{text if len(text) <= 80 else text[:80] + "…"}"'
    return str(value)
