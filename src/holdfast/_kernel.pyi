"""The compiled kernel. Private: go through the typed functions that wrap it."""

from collections.abc import Sequence

import numpy as np
import numpy.typing as npt

_Floats = npt.NDArray[np.float64]
_Words = tuple[int, int, int, int, int]

def simd() -> str: ...
def sources() -> str: ...
def exp(values: _Floats) -> _Floats: ...
def log(values: _Floats) -> _Floats: ...
def sin(values: _Floats) -> _Floats: ...
def cos(values: _Floats) -> _Floats: ...
def arctan2(y: _Floats, x: _Floats) -> _Floats: ...
def arcsin(value: float) -> float: ...
def sum(values: _Floats) -> float: ...  # noqa: A001
def all_finite(values: _Floats) -> bool: ...
def all_within(values: _Floats, least: float, most: float) -> bool: ...
def all_integers_within(values: npt.NDArray[np.int64], least: int, most: int) -> bool: ...
def weighted_sums(weights: _Floats, rows: _Floats) -> _Floats: ...
def normalize(log_weights: _Floats, drop_negligible: bool) -> tuple[_Floats, int]: ...
def belief_sizes(states: _Floats, weights: _Floats) -> tuple[float, int]: ...
def update(
    states: _Floats, weights: _Floats, log_likelihood: _Floats
) -> tuple[int, float, int]: ...
def update_by_gaussian(
    states: _Floats,
    weights: _Floats,
    observed: _Floats,
    mean: _Floats,
    variance: _Floats,
    circular: Sequence[int],
    posterior: _Floats,
) -> tuple[int, float, int, float] | None: ...
def philox(words: _Words, block: int) -> tuple[int, int, int, int, int]: ...
def substream(words: _Words, index: int) -> _Words: ...
def normals(words: _Words, count: int) -> _Floats: ...
def uniforms(words: _Words, count: int) -> _Floats: ...
def enter_standard_mode() -> int: ...
def restore_mode(mode: int) -> None: ...
def systematic_resample(weights: _Floats, offset: float) -> npt.NDArray[np.int64]: ...
def resample(
    states: _Floats, weights: _Floats, words: _Words, drawn: _Floats, drawn_weights: _Floats
) -> None: ...
def entropies(
    points: _Floats,
    weights: _Floats,
    logarithms: bool,
    estimator: int,
    neighbors: int,
    resolution: float,
    exponent: float,
    offset: float,
    threads: int,
    factors: Sequence[float],
    prior: _Floats,
    sampled: bool,
) -> tuple[_Floats, int, int, tuple[int, int, int]]: ...
def entropies_of_each(
    points: _Floats,
    weights: _Floats,
    estimator: int,
    neighbors: int,
    resolution: float,
    exponent: float,
    offset: float,
    threads: int,
    prior: _Floats,
) -> _Floats: ...
def use_threads_from(nanoseconds: float) -> float: ...

few_up_to: int
sample_of_groups: float

def take_as_few_up_to(points: int) -> int: ...
def threads_started() -> int: ...
def watch_interruption(flag: npt.NDArray[np.uint8] | None, most_s: float) -> None: ...
def is_interrupted() -> bool: ...
def hypothetical_entropies(
    weights: _Floats,
    sizes: Sequence[int],
    predicted: _Floats,
    variance: _Floats,
    samples: int,
    stream: _Words,
    circular: Sequence[int],
    points: _Floats,
    estimator: int,
    neighbors: int,
    resolution: float,
    exponent: float,
    offset: float,
    threads: int,
    factors: Sequence[float],
    prior: _Floats,
    unchanged: bool,
) -> tuple[_Floats, _Floats, int, int]: ...
def hypothetical_weights(
    weights: _Floats,
    sizes: Sequence[int],
    predicted: _Floats,
    variance: _Floats,
    samples: int,
    stream: _Words,
    circular: Sequence[int],
    drop_negligible: bool,
) -> _Floats: ...
def stratified(weights: _Floats, samples: int, stream: _Words) -> npt.NDArray[np.int64]: ...
def beliefs_without_truth(
    weights: _Floats,
    states: _Floats,
    truths: npt.NDArray[np.int64],
    stream: _Words,
    members: int,
    negligible: float,
) -> tuple[_Floats, _Floats] | None: ...
def measure_exp(count: int, repetitions: int) -> float: ...
def measure_visit(count: int, dimension: int, repetitions: int) -> float: ...

class PegPolicy2D:
    def __init__(
        self,
        stages: Sequence[tuple[float, float, float]],
        half_width: float,
        height: float,
        limits: Sequence[float],
        goal: tuple[float, float, float, float],
    ) -> None: ...

class PegPolicy3D:
    def __init__(
        self,
        half_width: float,
        upright_limit: float,
        limits: Sequence[float],
        goal_tolerance: float,
    ) -> None: ...

class ViaPointPolicy:
    def __init__(
        self, stages: Sequence[tuple[float, float, float, float, float]], step_size: float
    ) -> None: ...

class _World:
    def collides(self, states: _Floats, result: npt.NDArray[np.bool_]) -> bool: ...
    def move(
        self,
        states: _Floats,
        actions: _Floats,
        standard_deviation: _Floats,
        tolerance: float,
        stream: _Words,
        next_states: _Floats,
    ) -> bool: ...
    def follow(
        self,
        policy: PegPolicy2D | PegPolicy3D | ViaPointPolicy,
        states: _Floats,
        stage: int,
        offsets: Sequence[int],
        tolerance: float,
        threads: int,
        commands: bool,
        rows_at: _Floats,
        stages_at: npt.NDArray[np.int64],
    ) -> bool: ...
    def roll_out(
        self,
        policy: PegPolicy2D | PegPolicy3D | ViaPointPolicy,
        true_states: _Floats,
        estimates: _Floats,
        clouds: _Floats,
        stage: int,
        standard_deviation: _Floats,
        tolerance: float,
        stream: _Words,
        rollouts: tuple[int, int, int, float, float, bool],
        threads: int,
        returns: _Floats,
    ) -> bool: ...
    def move_each(
        self,
        states: _Floats,
        actions: _Floats,
        standard_deviation: _Floats,
        tolerance: float,
        streams: Sequence[_Words],
        threads: int,
        next_states: _Floats,
    ) -> bool: ...
    def draw_free(
        self, mean: _Floats, standard_deviation: _Floats, stream: _Words, states: _Floats
    ) -> int: ...

class DiscWorld(_World):
    def __init__(self, radius: float, obstacles: _Floats) -> None: ...

class RectangleWorld(_World):
    def __init__(self, width: float, height: float, obstacles: _Floats) -> None: ...

class BoxWorld(_World):
    def __init__(self, size_x: float, size_y: float, size_z: float, obstacles: _Floats) -> None: ...
