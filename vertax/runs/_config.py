"""Typed configurations: common keys, reading, checks, and templates."""

from __future__ import annotations

import copy
import difflib
import functools
import importlib
import json
import os
import re
import tomllib
from collections.abc import Iterable, Iterator, Mapping
from pathlib import Path
from typing import Any, Literal, TypeVar

from vertax._base.extras import requires_extra

with requires_extra("run", "The configuration of experiments"):
    import pydantic


class ConfigError(ValueError):
    """A configuration that cannot be used; the message names the key and what it may be."""


class Section(pydantic.BaseModel):
    """A table of a configuration file.

    Subclass it; each key is a field with a type, a default and a docstring below. Unknown keys and values of
    another type are rejected (an integer counts as a number, nothing else is converted).
    """

    model_config = pydantic.ConfigDict(
        extra="forbid", strict=True, frozen=True, allow_inf_nan=False, use_attribute_docstrings=True
    )

    # An experiment may change the defaults of a shared table, `fit: Fitting = Fitting(epochs=150)`.
    # They apply to each key of the table, also if the configuration sets another key of it.
    @pydantic.model_validator(mode="before")
    @classmethod
    def _complete(cls, data: Any) -> Any:
        if not isinstance(data, Mapping):
            return data
        defaults = {k: f.default for k, f in cls.model_fields.items() if _section(f)}
        tables = {k: d.model_dump() for k, d in defaults.items() if isinstance(d, Section)}
        return {k: _merge(tables[k], v) if k in tables else v for k, v in data.items()}


class ExperimentConfig(Section):
    """The keys of all jobs and experiments; subclasses add others."""

    experiment: str = ""
    """The job or experiment to run: the name of its module."""
    seed: int = pydantic.Field(default=0, ge=0, lt=2**63)
    """Seed of everything random."""
    precision: Literal["float64", "float32"] = "float64"
    """Precision of floating-point numbers."""

    @pydantic.model_validator(mode="after")
    def _seed_of_32_bits(self) -> Any:
        # JAX silently drops all but the lower 32 bits.
        if self.precision == "float32" and self.seed >= 2**32:
            raise ValueError(
                f"with precision float32, `seed` must be below 2**32, but is {self.seed}"
            )
        return self

    def __reduce__(self) -> Any:  # pickle does not find the class that `with_name` makes
        content = self.model_dump(mode="json", exclude_none=True)
        return _restored, (type(self).__module__, self.experiment, content)


def _restored(module: str, name: str, content: dict[str, Any]) -> ExperimentConfig:
    return validate(with_name(importlib.import_module(module).Config, name), content)


Model = TypeVar("Model", bound=Section)


@functools.cache
def with_name(config: type[ExperimentConfig], name: str) -> type[ExperimentConfig]:
    """A subclass of a configuration with a key `experiment` that accepts one name only."""
    key = pydantic.Field(name, description=config.model_fields["experiment"].description)
    fields: dict[str, Any] = {"experiment": (Literal[name], key)}
    return pydantic.create_model(
        config.__name__, __base__=config, __module__=config.__module__, **fields
    )


def read_toml(path: str | os.PathLike[str]) -> dict[str, Any]:
    """The content of a TOML file; a `ConfigError` names a file that cannot be read."""
    try:
        # Editors on Windows write a byte-order mark.
        return tomllib.loads(Path(path).read_text(encoding="utf-8-sig"))
    except OSError as error:
        raise ConfigError(f"Cannot read {os.fspath(path)}: {error.strerror}.") from error
    except ValueError as error:  # of TOML, of text that is not UTF-8, or of a name that is no path
        raise ConfigError(f"{os.fspath(path)} is not valid TOML: {error}.") from error
    except RecursionError:
        raise ConfigError(f"{os.fspath(path)} is nested too deeply.") from None


def apply_overrides(data: Mapping[str, Any], overrides: Iterable[str]) -> dict[str, Any]:
    """A copy of a configuration with single keys set by texts such as `"fit.epochs=50"`.

    A value is written as in TOML; any other text is a string. The last override of a key is used.
    """
    config = copy.deepcopy(dict(data))
    for override in overrides:
        key, equals, text = override.partition("=")
        *tables, name = parts = [part.strip() for part in key.split(".")]
        if not equals or not all(parts):
            raise ConfigError(
                f"An override must have the form key=value, as in fit.epochs=50, but is {override!r}."
            )
        if not text.strip():
            raise ConfigError(
                f"An override must have a value, but {override!r} has none: is a variable unset? An empty "
                f"text is {key}='\"\"'."
            )
        table = config
        for part in tables:
            table = table.setdefault(part, {})
            if not isinstance(table, dict):
                raise ConfigError(
                    f"Cannot set `{'.'.join(parts)}`: `{part}` is {table!r} and not a table. Set either "
                    f"`{part}` or its keys."
                )
        table[name] = _parse(text)
    return config


def validate(
    model: type[Model], data: Mapping[str, Any], where: str = "the configuration"
) -> Model:
    """The configuration as an instance of `model`; a `ConfigError` lists all mistakes by key."""
    try:
        return model.model_validate(dict(data))
    except pydantic.ValidationError as error:
        keys = list(all_keys(model))
        lines = [_explain(keys, mistake) for mistake in error.errors(include_url=False)]
        listed = "\n  ".join(["", *lines]) if len(lines) > 1 else f" {lines[0]}"
        raise ConfigError(f"In {where}:{listed}") from None


def all_keys(model: type[Section], prefix: str = "") -> Iterator[str]:
    """All dotted keys of a configuration; a table comes before its keys."""
    for name, field in model.model_fields.items():
        yield prefix + name
        if section := _section(field):
            yield from all_keys(section, f"{prefix}{name}.")


def differences(then: Any, now: Any, name: str = "") -> list[str]:
    """Differences between two configurations, one sentence for each key."""
    if isinstance(then, Mapping) and isinstance(now, Mapping):
        keys, prefix = dict.fromkeys([*then, *now]), f"{name}." if name else ""
        return [d for k in keys for d in differences(then.get(k), now.get(k), prefix + k)]
    return [] if then == now else [f"`{name}` was {then!r} and is {now!r}"]


def template(model: type[ExperimentConfig], name: str) -> str:
    """A TOML file with every key at its default, each explained in a comment."""
    schema = model.model_json_schema()
    defaults = model.model_construct().model_dump(mode="json")
    lines = _template_lines(schema, schema.get("$defs", {}), defaults, "")
    return "\n".join([f'experiment = "{name}"', *lines]) + "\n"


def _template_lines(schema: Any, tables: Any, defaults: Any, prefix: str) -> Iterator[str]:
    sections = []
    for name, key in schema["properties"].items():
        default = defaults.get(name, key.get("default"))
        section = tables.get(key.get("$ref", "").rpartition("/")[2])
        # Pydantic leaves out the description of a key that is that of the table.
        about = " ".join(({"description": ""} | (section or {}) | key)["description"].split())
        if section is not None:
            sections += ["", f"[{prefix}{name}]  # {about}"]
            sections += _template_lines(section, tables, default or {}, f"{prefix}{name}.")
        elif prefix or name != "experiment":
            yield f"# {about} ({_in_words(key)})"
            required = name in schema.get("required", ()) and default is None
            value = "" if default is None else f" {_in_toml(default)}"
            yield f"{'' if value or required else '# '}{name} ={value}"
    yield from sections


_TYPES = {"integer": "an integer", "number": "a number", "boolean": "true or false"}
_BOUNDS = {"minimum": "at least", "exclusiveMinimum": "above", "maximum": "at most"}
_BOUNDS["exclusiveMaximum"] = "below"


def _in_words(schema: Mapping[str, Any]) -> str:
    """The values that a JSON schema allows."""
    if "anyOf" in schema:
        return " or ".join(_in_words(each) for each in schema["anyOf"] if each != {"type": "null"})
    if "enum" in schema:
        return "one of " + ", ".join(map(_in_toml, schema["enum"]))
    kind = schema.get("type", "object")
    if kind == "array":
        return f"a list, each entry {_in_words(schema.get('items', schema.get('prefixItems', [{}])[0]))}"
    bounds = [f"{words} {schema[bound]}" for bound, words in _BOUNDS.items() if bound in schema]
    return ", ".join([_TYPES.get(kind, "a string" if kind == "string" else "a table"), *bounds])


def _explain(keys: list[str], mistake: Any) -> str:
    """One mistake, as Pydantic reports it, in a sentence."""
    name, kind = ".".join(str(part) for part in mistake["loc"]), mistake["type"]
    if kind == "extra_forbidden":
        if near := _nearest(name, keys):
            return f"there is no key `{name}`; did you mean `{near}`?"
        siblings = [k for k in keys if k.rpartition(".")[0] == name.rpartition(".")[0]]
        return f"there is no key `{name}`; allowed are: {', '.join(f'`{k}`' for k in siblings)}."
    if kind == "missing":
        return f"`{name}` is missing."
    if kind == "value_error":  # of a validator of a section
        text = str(mistake["ctx"]["error"]).removesuffix(".")
        return f"`{name}`: {text}." if name else f"{text}."
    words = re.sub(r"^\w+ should ", "", mistake["msg"]).removesuffix(" after validation")
    words = "be a table" if kind == "model_type" else words
    value = _in_toml(mistake["input"])
    return f"`{name}` must {words}, but is {value if len(value) <= 80 else value[:80] + '…'}."


def _nearest(name: str, keys: Iterable[str]) -> str | None:
    """The most similar key, also in another table."""
    alike = lambda a, b: difflib.SequenceMatcher(None, a, b).ratio()
    last = lambda key: key.rpartition(".")[2]
    best = max(keys, key=lambda key: alike(last(key), last(name)) + 0.5 * alike(key, name))
    return best if alike(last(best), last(name)) > 0.65 else None


def _section(field: pydantic.fields.FieldInfo) -> type[Section] | None:
    kind: Any = field.annotation
    return kind if isinstance(kind, type) and issubclass(kind, Section) else None


def _parse(text: str) -> Any:
    try:
        table = tomllib.loads(f"value = {text}")
    except ValueError:  # no TOML, or a number of thousands of digits
        return text.strip()
    except RecursionError:
        raise ConfigError(f"The value {text[:20]}… is nested too deeply.") from None
    # A text with line breaks could set more keys.
    return table["value"] if table.keys() == {"value"} else text.strip()


def _merge(below: Mapping[str, Any], above: Any) -> Any:
    """Two nested tables as one; the values of `above` replace those of `below`."""
    if not isinstance(above, Mapping):
        return above
    nested = {k: _merge(below[k], v) for k, v in above.items() if isinstance(below.get(k), Mapping)}
    return {**below, **above, **nested}


def _in_toml(value: Any) -> str:
    """A value as it is written in TOML."""
    if isinstance(value, Mapping):
        return f"{{ {', '.join(f'{k} = {_in_toml(v)}' for k, v in value.items())} }}"
    if isinstance(value, list | tuple):
        return f"[{', '.join(map(_in_toml, value))}]"
    return json.dumps(value, ensure_ascii=False, default=str)
