"""Settings that cost as much as they can, found by looking at the settings' own bounds."""

import itertools
from collections.abc import Iterator
from typing import NamedTuple, get_args

import msgspec
from msgspec import inspect

from holdfast.planning.settings import Estimator, Method, PlanningSettings, unfit_for_the_method

UNBOUNDED = 10**9
"""Tried where a key has no upper bound."""


class Hostile(NamedTuple):
    """Settings, the method among them, and the key that is at its maximum."""

    key: str
    settings: PlanningSettings


class NumericKey(NamedTuple):
    """A key whose value is a number, or a list of so many (length 0: a single one)."""

    path: tuple[str, ...]
    least: float
    most: float
    is_whole: bool
    length: int = 0


def keys_of(kind: type) -> list[NumericKey]:
    """Return all numeric keys of a struct and of the structs in it, with their bounds."""
    return list(_numeric(inspect.type_info(kind), ()))


def _numeric(kind: inspect.Type, path: tuple[str, ...], length: int = 0) -> Iterator[NumericKey]:
    if isinstance(kind, inspect.StructType):
        for field in kind.fields:
            yield from _numeric(field.type, (*path, field.encode_name))
    elif isinstance(kind, inspect.UnionType):
        for each in kind.types:
            yield from _numeric(each, path)
    elif isinstance(kind, inspect.VarTupleType | inspect.ListType):
        yield from _numeric(kind.item_type, path, min(kind.max_length or 64, 10_000))
    elif isinstance(kind, inspect.TupleType):
        yield from _numeric(kind.item_types[0], path, len(kind.item_types))
    elif isinstance(kind, inspect.IntType | inspect.FloatType):
        least = next((each for each in (kind.ge, kind.gt) if each is not None), -UNBOUNDED)
        most = next((each for each in (kind.le, kind.lt) if each is not None), UNBOUNDED)
        yield NumericKey(path, least, most, isinstance(kind, inspect.IntType), length)


def numeric_keys() -> dict[str, NumericKey]:
    """Return all keys of the settings whose values are numbers or tuples of numbers."""
    found: dict[str, NumericKey] = {}
    for key in keys_of(PlanningSettings):
        found.setdefault(".".join(key.path), key)
    return found


def with_key(settings: PlanningSettings, key: str, value: object) -> PlanningSettings:
    """Return settings with another value of a key."""
    section, _, name = key.rpartition(".")
    if not section:
        return msgspec.structs.replace(settings, **{name: value})
    own = msgspec.structs.replace(getattr(settings, section), **{name: value})
    return msgspec.structs.replace(settings, **{section: own})


def _greatest(bounds: NumericKey) -> object:
    most = int(bounds.most) if bounds.is_whole else bounds.most
    if not bounds.length:
        return most
    return tuple(range(int(most) - bounds.length + 1, int(most) + 1))


def made_fit(settings: PlanningSettings) -> PlanningSettings:
    """Change what the method cannot use, but for what costs."""
    for _ in range(8):
        particles = settings.particle_filter.num_particles
        unfit = unfit_for_the_method(settings)
        if unfit is None:
            return settings
        (section, name), _ = unfit
        key = f"{section}.{name}"
        value: object = 1
        if name == "num_nearest_neighbors":
            value = particles - 1
        elif name == "num_particles":
            value = 4096
        elif name == "max_observation_samples":
            value = settings.active_sensing.num_observation_samples
        elif name == "path_offsets":
            settings = with_key(settings, "selector.path_unit", "steps")
            value = settings.selector.path_offsets
        settings = with_key(settings, key, value)
    raise AssertionError(f"{settings} cannot be made fit")


def hostile_settings(most_particles: int = 1_000_000) -> Iterator[Hostile]:
    """Return for each method settings with each numeric key at its maximum, and with all of them.

    ``most_particles`` stands in for the maximum of the particles, of which a service takes fewer.
    """
    keys = numeric_keys()
    greatest = {key: _greatest(bounds) for key, bounds in keys.items()}
    greatest["particle_filter.num_particles"] = most_particles
    estimators: tuple[str | None, ...] = (None, *get_args(Estimator))
    for method, estimator in itertools.product(get_args(Method), estimators):
        plain = with_key(PlanningSettings(), "selector.method", method)
        plain = with_key(plain, "selector.estimator", estimator)
        everything = plain
        for key, value in greatest.items():
            yield Hostile(key, made_fit(with_key(plain, key, value)))
            everything = with_key(everything, key, value)
        yield Hostile("all", made_fit(everything))
