"""The kernel by itself: known answers, orders of sums, one result on every instruction set."""

import json
import math
import os
import platform
import resource
import subprocess
import sys
from collections.abc import Iterator

import numpy as np
import pytest
from tests.programs import completed

from holdfast import _kernel
from holdfast.numerics.arrays import FloatArray, IntArray
from holdfast.numerics.reproducible import log, wrapped
from holdfast.planning.belief import uniform_weights
from holdfast.planning.planner import Planner
from holdfast.problems.peg_in_hole_2d import PegInHole2D

WORDS = (7, 0, 3, 2, 1)

# Counter, key and block, in hexadecimal.
KNOWN_ANSWERS = [
    "0 0 0 0 0 0 6627e8d5 e169c58d bc57ac4c 9b00dbd8",
    f"{'ffffffff ' * 6}408f276d 41c83b0e a20bc7c6 6d5451fd",
    "243f6a88 85a308d3 13198a2e 03707344 a4093822 299f31d0 d16cfe09 94fdcceb 5001e420 24126ea1",
]

# A bit of everything that has several compilations, in sizes that leave every remainder modulo 8,
# and the functions that have one. Prints a hash for each, by name.
WORKLOAD = """
import hashlib, json
import numpy as np
from holdfast import _kernel as kernel
from holdfast.numerics.geometry import BoxWorld, DiscWorld, RectangleWorld, RolloutSettings
from holdfast.numerics.randomness import Stream
from holdfast.problems.capsule_robot import CapsuleRobot
from holdfast.problems.multitier_peg_in_hole_2d import MultitierPegInHole2D
from holdfast.problems.peg_in_hole_2d import PegInHole2D
from holdfast.problems.peg_in_hole_3d import PegInHole3D

words = (7, 0, 3, 2, 1)
stream = Stream(words)
alone = ((1.0,), np.empty(0))  # one set of points, no prior
hashes = {}

def note(name, *arrays):
    total = hashlib.sha256()
    for array in arrays:
        total.update(np.ascontiguousarray(array).tobytes())
    hashes[name] = total.hexdigest()

wide = np.concatenate([
    stream.normal(4001) * 400.0,
    stream.substream(1).normal(4000) * 1e-3,
    [0.0, -0.0, np.inf, -np.inf, 5e-324, -5e-324, 2.0**30, 709.8, -707.71, 1e-300, 1e300],
])
positive = np.abs(wide)
for function, values in (
    (kernel.exp, wide), (kernel.log, positive), (kernel.sin, wide), (kernel.cos, wide)
):
    note(function.__name__, *(function(values[n:2 * n + 1]) for n in (0, 1, 5, 9, 300, 3999)),
         function(values[np.isfinite(values)]), function(values[:16]))
others = np.concatenate([wide[::-1], wide])
note("arctan2", *(kernel.arctan2(np.tile(wide, 2)[n:2 * n + 1], others[n:2 * n + 1])
                  for n in (0, 1, 5, 9, 300, 8005)))
note("specials", *(np.isnan(f(wide)) for f in (kernel.exp, kernel.sin)), kernel.exp(wide[8001:]))
note("arcsin", np.array([kernel.arcsin(x) for x in np.linspace(-1.0, 1.0, 1001)]))
note("normals", *(kernel.normals(words, n) for n in (0, 1, 2, 3, 7, 15, 16, 17, 1001)))
note("uniforms", *(kernel.uniforms(words, n) for n in (0, 1, 2, 3, 7, 15, 16, 17, 1001)))
for n in (1, 7, 8, 9, 31, 1000):
    values = stream.substream(2).normal(n)
    note(f"sum {n}", np.array(kernel.sum(values)))
    rows = stream.substream(3).normal((n, 5))
    note(f"weighted sums {n}", kernel.weighted_sums(values, rows))
    note(f"normalize {n}", kernel.normalize(values * 20.0, False)[0])
    weights = kernel.normalize(values, False)[0]
    note(f"resampling {n}", kernel.systematic_resample(weights, 0.37))
    for variance in (rows[0]**2, rows**2):
        numbers = kernel.update_by_gaussian(rows, weights, rows[0], rows, variance, (1, 3), values)
        note(f"update {n} {variance.shape}", numbers, values)
    kernel.resample(rows, weights, words, drawn := np.empty((n, 5)), values)
    note(f"drawn {n}", drawn, values)

# Every way to an entropy, with its index in the kernel's own count: pair by pair, with a tree of
# its own, and grouped in one to four vectors and in more than one group.
kernel.use_threads_from(0.0)
wrong_ways = []
for count, dimension, kept, posteriors, way in (
    (12, 1, 12, 3, 0), (24, 2, 24, 2, 0), (300, 6, 20, 40, 0),
    (40, 2, 40, 2, 1), (333, 3, 333, 1, 1), (1500, 1, 1400, 1, 1), (1500, 3, 90, 2, 1),
    (3000, 6, 3000, 1, 1),
    (200, 3, 190, 7, 2), (300, 2, 300, 13, 2), (300, 6, 200, 20, 2), (300, 3, 150, 30, 2),
    (64, 4, 64, 32, 2), (600, 5, 220, 20, 2), (300, 3, 270, 33, 2), (1500, 1, 1400, 12, 2),
    (2500, 6, 2400, 9, 2),
):
    draw = stream.substream(1000 * count + kept)
    points = draw.normal((count, dimension))
    points[::3] = np.round(points[::3], 1)
    normals = draw.substream(1).normal((posteriors, count))
    normals[:, kept:] = -np.inf
    # Weights within a factor of 50, of which none is negligible, and ones of which most are.
    for deviation in (0.4, 3.0):
        log_weights = normals * deviation
        for neighbors in (1, 5, 8, 9, 30):
            for resolution in (1e-9, 0.2, 20.0) if deviation < 1.0 else (0.2,):
                result, _, visits, ways = kernel.entropies(
                    points, log_weights, True, 0, neighbors, resolution, 0.0, 0.0, 2, *alone, True)
                name = f"nearest {count} {dimension} {kept} {deviation} {neighbors} {resolution}"
                note(name, result, np.array(visits))
                if deviation < 1.0 and ways[way] != posteriors:
                    wrong_ways.append(name)
    for exponent in (0.5, 0.125):
        result, _, visits, ways = kernel.entropies(
            points * 3.0, normals * 0.4, True, 1, 1, 1.0, exponent, 0.3, 2, *alone, True)
        name = f"mixture {count} {dimension} {kept} {exponent}"
        note(name, result, np.array(visits))
        if ways[way] != posteriors:
            wrong_ways.append(name)

    usual = kernel.take_as_few_up_to(0)
    for resolution in (1e-9, 0.2, 2.0):
        result, _, visits, _ = kernel.entropies(
            points, normals * 0.4, True, 0, 5, resolution, 0.0, 0.0, 2, *alone, True)
        note(f"blocks {count} {dimension} {kept} {resolution}", result, np.array(visits))
    kernel.take_as_few_up_to(usual)

    result, *_ = kernel.entropies(points, normals, True, 2, 1, 1.0, 0.0, 0.0, 2, *alone, True)
    note(f"variance {count} {dimension} {kept}", result)
    prior = np.full(count, 1.0 / count)
    for name, own in (("spread", points), ("few", np.round(points))):
        result, *_ = kernel.entropies(own, normals, True, 3, 5, 0.1, 0., 0., 2, (1.0,), prior, True)
        note(f"prior neighbours {count} {dimension} {kept} {name}", result)

kernel.take_as_few_up_to(0)
points, normals = stream.substream(7).normal((5000, 3)), stream.substream(8).normal((9, 5000))
for kind, own in ((0, 1e-9), (0, 0.2), (0, 2.0), (1, 1.0)):
    note(f"sample {kind} {own}", kernel.entropies(
        points, normals, True, kind, 5, own, 0.5, 0.0, 2, *alone, True)[0])
for count in (5, 100, 1001):
    draw = stream.substream(count)
    states = draw.normal((count, 3))
    predicted = np.ascontiguousarray(np.concatenate([states.T, states.T[:2]]))
    weights = kernel.normalize(draw.substream(1).normal(count), False)[0]
    for variance, circular in ((np.full((5, 1), 0.1), []), (np.full((5, 1), 0.1), [0, 1, 0, 0, 1]),
                               (np.ascontiguousarray(0.1 + predicted**2), [])):
        arguments = (weights, [1, 1, 1, 2], predicted, variance, 9, words, circular)
        found = kernel.hypothetical_entropies(
            *arguments, np.ascontiguousarray(-states), 0, 3, 0.05, 0.0, 0.0, 2, *alone, True)
        note(f"hypotheses {count} {variance.shape} {circular}", *found[:2],
             kernel.hypothetical_weights(*arguments, True),
             kernel.hypothetical_weights(*arguments, False))

deviation = np.full(6, 0.1)
flat = [(-3.0, -2.0, -1.0, -1.5), (0.5, -1.0, 0.7, 2.0)]
boxes = [(-3.0, -2.0, -1.0, -1.0, -1.5, 1.0), (0.5, -1.0, -2.0, 0.7, 2.0, 0.3)]
for world, size in ((DiscWorld(0.4, flat), 2), (RectangleWorld(0.6, 1.4, flat), 3),
                    (BoxWorld((0.6, 1.0, 1.6), boxes), 6)):
    states = stream.substream(size).normal((300, size)) * 2.0
    states = states[~world.collides(states)]
    note(type(world).__name__,
         world.move(states, -states, deviation[:size], 1e-3, stream.substream(9)))

for problem in (PegInHole2D(), MultitierPegInHole2D(), PegInHole3D(), CapsuleRobot()):
    states = problem.initial_states(stream.substream(10), 99)
    for stage in range(problem.num_stages):
        note(f"way {problem.name} {stage}", *problem.expected_path(states, stage, (0, 9, 99), 2),
             problem._path_actions(states, stage, (0, 9, 99), 2))
        for counts_steps in (False, True):
            note(f"rollouts {problem.name} {stage} {counts_steps}", problem.rollout_returns(
                states[:21], np.stack([states[i:21 + i] for i in (0, 9, 9)]),
                np.stack([states[i:42 + i].reshape(21, 2, -1) for i in (9, 57, 57)]), stage,
                stream.substream(11), RolloutSettings(9, 8, 200, 0.99, 0.5, counts_steps), 2))
print(json.dumps({"simd": kernel.simd(), "threads": kernel.threads_started(),
                  "wrong_ways": wrong_ways, "hashes": hashes}))
"""

# Makes the processor flush subnormal numbers to zero in this thread, and in those that it starts.
FLUSHING = """
import ctypes
import numpy as np

libm = ctypes.CDLL("libm.so.6")
mode = (ctypes.c_uint32 * 8)()  # the C library's fenv_t; the last word is MXCSR
assert libm.fegetenv(mode) == 0
mode[7] |= 0x8040
assert libm.fesetenv(mode) == 0
smallest = np.array([5e-324])

def is_flushing():
    return not (smallest + smallest).any()

assert is_flushing()
"""


def run_workload(
    simd: str | None, before: str = "", after: str = ""
) -> subprocess.CompletedProcess[str]:
    # Two threads, however many processors there are.
    environment = os.environ | {"OMP_NUM_THREADS": "2"}
    environment.pop("HOLDFAST_SIMD", None)
    if simd is not None:
        environment["HOLDFAST_SIMD"] = simd
    return completed(
        [sys.executable, "-W", "ignore", "-c", before + WORKLOAD + after],
        env=environment,
        timeout=120,
    )


@pytest.fixture(scope="module")
def best() -> subprocess.CompletedProcess[str]:
    """Return what the instruction set that this machine would choose gives."""
    finished = run_workload(None)
    assert finished.returncode == 0, finished.stderr
    return finished


@pytest.fixture(scope="module")
def best_hashes(best: subprocess.CompletedProcess[str]) -> dict[str, str]:
    """Return the hashes of it."""
    result = json.loads(best.stdout)
    assert result["wrong_ways"] == []
    assert result["threads"] == 1
    hashes = result["hashes"]
    assert isinstance(hashes, dict)
    return hashes


class TestInstructionSets:
    @pytest.mark.parametrize("simd", ["baseline", "avx2", "avx512"])
    def test_all_give_the_same_bits(
        self, simd: str, best: subprocess.CompletedProcess[str], best_hashes: dict[str, str]
    ) -> None:
        chosen = json.loads(best.stdout)["simd"]
        finished = best if simd == chosen else run_workload(simd)
        if simd != "baseline" and "allowed here are baseline" in finished.stderr:
            pytest.skip(f"this processor has no {simd}")
        assert finished.returncode == 0, finished.stderr
        result = json.loads(finished.stdout)
        assert result["simd"] == simd
        different = [name for name in best_hashes if result["hashes"][name] != best_hashes[name]]
        assert not different
        assert len(best_hashes) > 400

    def test_an_unknown_one_is_refused_by_name(self) -> None:
        finished = run_workload("mmx")
        assert finished.returncode != 0
        assert "HOLDFAST_SIMD=mmx: allowed here are baseline" in finished.stderr


class TestFloatingPointMode:
    """Whatever mode the calling thread is in: the same bits, and its mode as it was."""

    @pytest.mark.skipif(
        platform.machine() != "x86_64" or platform.libc_ver()[0] != "glibc",
        reason="the mode is set through glibc's fenv_t of x86-64",
    )
    def test_flushing_of_subnormal_numbers(self, best_hashes: dict[str, str]) -> None:
        finished = run_workload(None, FLUSHING, "assert is_flushing()")
        assert finished.returncode == 0, finished.stderr
        hashes = json.loads(finished.stdout)["hashes"]
        different = [name for name in best_hashes if hashes[name] != best_hashes[name]]
        assert not different


class TestPhilox:
    """The known answers that the generator's authors publish with their code."""

    @pytest.mark.parametrize("answer", KNOWN_ANSWERS)
    def test_known_answers(self, answer: str) -> None:
        block, c1, c2, c3, key0, key1, *expected = (int(word, 16) for word in answer.split())
        assert list(_kernel.philox((key0, key1, c1, c2, c3), block)[:4]) == expected

    def test_uniforms_are_the_words_of_the_blocks(self) -> None:
        expected = []
        for block in range(4):
            w = _kernel.philox(WORDS, block)
            for high, low in ((w[0], w[1]), (w[2], w[3])):
                expected.append(((high << 21) | (low >> 11)) * 2.0**-53)
        assert _kernel.uniforms(WORDS, 8).tolist() == expected
        assert _kernel.uniforms(WORDS, 7).tolist() == expected[:7]

    def test_normals_are_made_of_pairs_of_uniforms(self) -> None:
        """Box and Muller's formula, to rounding; and the same bits however many are asked for."""
        count = 2000
        uniforms = _kernel.uniforms(WORDS, count).reshape(-1, 2)
        radius = np.sqrt(-2.0 * np.log1p(-uniforms[:, 0]))
        angle = 2.0 * np.pi * uniforms[:, 1]
        expected = np.stack([radius * np.cos(angle), radius * np.sin(angle)], axis=1).reshape(-1)
        normals = _kernel.normals(WORDS, count)
        np.testing.assert_allclose(normals, expected, rtol=1e-13, atol=1e-14)
        for fewer in range(40):
            assert _kernel.normals(WORDS, fewer).tobytes() == normals[:fewer].tobytes()


class TestSums:
    @pytest.mark.parametrize("count", [0, 1, 7, 8, 9, 64, 1001])
    def test_elements_are_added_in_the_documented_order(self, count: int) -> None:
        """Element i goes to partial sum i mod 8; the far four are added to the near four."""
        values = _kernel.normals(WORDS, count) * 1e3
        partial = [0.0] * 8
        for i, value in enumerate(values.tolist()):
            partial[i % 8] += value
        a0, a1, a2, a3 = (partial[i] + partial[i + 4] for i in range(4))
        result = _kernel.sum(values)
        assert result == (a0 + a2) + (a1 + a3)
        # Each of at most n additions rounds by half a unit of a partial sum, no larger than this.
        bound = count * 2.0**-53 * math.fsum(abs(values))
        assert abs(result - math.fsum(values)) <= bound

    @pytest.mark.parametrize("count", [1, 7, 8, 9, 1001])
    def test_weighted_sums_are_the_sums_of_products(self, count: int) -> None:
        weights = _kernel.uniforms(WORDS, count)
        rows = _kernel.normals(WORDS, count * 3).reshape(count, 3)
        expected = [_kernel.sum(weights * np.ascontiguousarray(rows[:, c])) for c in range(3)]
        assert _kernel.weighted_sums(weights, rows).tolist() == expected


class TestNormalize:
    """Log weights to weights that sum to 1, without overflow or underflow of the whole."""

    @pytest.mark.parametrize("shift", [0.0, -1e6, 1e6, -1e300, 1e300])
    def test_a_common_factor_makes_no_difference(self, shift: float) -> None:
        log_weights = np.log(np.array([0.1, 0.2, 0.3, 0.4]))
        weights, survivors = _kernel.normalize(log_weights + shift, False)
        # Adding the shift rounds: half a unit of it is what is lost.
        tolerance = 1e-15 + abs(shift) * 2.0**-52 if abs(shift) < 1e10 else 1.0
        np.testing.assert_allclose(weights, [0.1, 0.2, 0.3, 0.4], atol=tolerance)
        assert survivors == 4
        assert math.isclose(float(weights.sum()), 1.0, abs_tol=1e-15)

    def test_what_underflows_next_to_the_largest_is_not_counted(self) -> None:
        weights, survivors = _kernel.normalize(
            np.array([0.0, -13.0, -700.0, -710.0, -np.inf]), False
        )
        assert survivors == 3
        assert weights[2] > 0.0
        assert weights[3:].tolist() == [0.0, 0.0]

    @pytest.mark.parametrize("given", ["-inf -inf", "nan 0", "0 nan", "0 -inf nan 1", "inf 0"])
    def test_no_posterior_is_said_so(self, given: str) -> None:
        assert _kernel.normalize(np.array(given.split(), float), False)[1] == 0


class TestUpdate:
    """Bayes' rule in one call: bit for bit what plain NumPy gives, column by column."""

    @pytest.mark.parametrize("varies", [False, True])
    def test_against_numpy(self, varies: bool) -> None:
        draw, seen = np.random.default_rng(1), set()
        for _ in range(2000):
            count, size = int(draw.choice([1, 2, 7, 8, 9, 40])), int(draw.integers(1, 4))
            states = np.round(draw.normal(size=(count, 2)))  # many alike, and -0.0
            weights = draw.random(count) * (draw.random(count) < draw.choice([0.6, 1.0]))
            weights = weights / weights.sum() if weights.any() else uniform_weights(count)
            observed, mean = draw.uniform(-1, 1, size), draw.uniform(-1, 1, (count, size))
            observed *= draw.choice([-0.0, 1e-160, 1.0, 9.0, 1e153, 1.7e308])
            mean *= draw.choice([-0.0, 1e-160, 1.0, 9.0, 1e153, 1.7e308])
            variance = np.exp(draw.normal(size=(count, size) if varies else size) * 9.0)
            circular = [angle for angle in range(size) if draw.random() < 0.3]

            with np.errstate(over="ignore", invalid="ignore"):
                difference, distances = observed - mean, np.zeros(count)
                for angle in circular:
                    difference[:, angle] = wrapped(difference[:, angle])
                for squares in (difference * difference / variance).T:
                    distances += squares
            log_likelihood = -0.5 * distances
            for column in variance.T if varies else ():
                log_likelihood -= 0.5 * log(column)
            posterior, survivors = _kernel.normalize(log(weights) + log_likelihood, False)
            own = posterior if survivors else weights
            distinct = 1 + int(np.count_nonzero((states[1:] != states[:-1]).any(axis=1)))
            numbers = survivors, 1.0 / _kernel.sum(own * own), distinct
            nearest = np.where(weights > 0.0, distances, np.inf).min()

            found = np.empty(count)
            given = observed, mean, variance, circular
            *sizes, squared = _kernel.update_by_gaussian(states, weights, *given, found) or (0.0,)
            np.testing.assert_array_equal([*sizes, squared], [*numbers, nearest])
            assert _kernel.update(states, weights, log_likelihood) == numbers
            if survivors:
                assert found.tobytes() == log_likelihood.tobytes() == posterior.tobytes()
            seen.add((bool(circular), "finite" if squared < np.inf else str(squared)))
        assert len(seen) == 5


class TestResampling:
    def resample(self, weights: FloatArray, offset: float) -> IntArray:
        indices = _kernel.systematic_resample(weights, offset)
        assert indices.dtype == np.int64
        return np.bincount(indices, minlength=weights.shape[0])

    @pytest.mark.parametrize("offset", [0.0, 0.25, 0.5, 1.0 - 2.0**-53])
    @pytest.mark.parametrize("count", [1, 2, 10, 1000])
    def test_every_particle_is_there_its_share_rounded(self, count: int, offset: float) -> None:
        weights = np.exp(_kernel.normals(WORDS, count) * 2.0)
        weights /= weights.sum()
        copies = self.resample(weights, offset)
        assert copies.sum() == count
        assert (copies >= np.floor(count * weights - 1e-9)).all()
        assert (copies <= np.ceil(count * weights + 1e-9)).all()

    @pytest.mark.parametrize("offset", [0.0, 0.5, 1.0 - 2.0**-53])
    def test_particles_of_weight_zero_die(self, offset: float) -> None:
        weights = np.array([0.0, 0.0, 0.3, 0.0, 0.7, 0.0, 0.0])
        copies = self.resample(weights, offset)
        assert copies[[0, 1, 3, 5, 6]].tolist() == [0] * 5
        assert copies.sum() == 7

    @pytest.mark.parametrize("factor", [0.25, 1.0 - 1e-9, 1.0 + 1e-9, 8.0])
    def test_weights_need_not_sum_to_one(self, factor: float) -> None:
        """The comb is as long as their sum, so that rounding in it does no harm."""
        weights = np.array([0.125, 0.5, 0.25, 0.125])
        for offset in (0.0, 0.3, 1.0 - 2.0**-53):
            copies = self.resample(weights * factor, offset)
            assert copies.sum() == 4
            assert (np.abs(copies - 4 * weights) < 1.0).all()


def test_arrays_of_a_decision_keep_their_memory() -> None:
    """With 1,000 particles all pages came anew each time: 90 faults a decision."""
    planner = Planner(PegInHole2D(), particles=1000)
    faults = [resource.getrusage(resource.RUSAGE_SELF).ru_minflt]
    for _ in range(30):
        planner.choose_sensing_action(planner.init(1, 0))
        faults.append(resource.getrusage(resource.RUSAGE_SELF).ru_minflt)
    assert sorted(np.diff(faults))[15] < 10


class TestThreads:
    """As many threads as wanted: the same bits."""

    @pytest.fixture(autouse=True)
    def any_work_is_worth_a_thread(self) -> Iterator[None]:
        usual = _kernel.use_threads_from(0.0)
        yield
        assert _kernel.use_threads_from(usual) == 0.0

    @pytest.mark.parametrize("estimator", [0, 1, 2, 3])
    @pytest.mark.parametrize(("count", "posteriors"), [(100, 30), (1500, 40), (4000, 3)])
    def test_entropies(self, count: int, posteriors: int, estimator: int) -> None:
        points = _kernel.normals(WORDS, count * 3).reshape(count, 3)
        log_weights = _kernel.normals((8, 0, 3, 2, 1), posteriors * count).reshape(posteriors, -1)
        # Posteriors of all sizes, so that more than one way is taken.
        for row in range(posteriors):
            log_weights[row, count // (1 + row % 7) :] = -np.inf
        log_weights[0, 20:] = -np.inf
        prior = np.full(count, 1.0 / count)
        results = set()
        for threads in (1, 2, 3, 64, 0):
            result, _, visits, ways = _kernel.entropies(
                points, log_weights, True, estimator, 5, 0.1, 0.5, 0.0, threads, (1.0,), prior, True
            )
            results.add((result.tobytes(), visits, ways))
            # The others have but one way.
            assert (ways[0] > 0) == (estimator < 2)
            assert (ways[1] + ways[2] > 0) == (estimator < 2)
        assert len(results) == 1
        if _processors() > 1:
            assert _kernel.threads_started() > 0


def _processors() -> int:
    """Return how many threads the kernel uses at most."""
    limit = os.environ.get("OMP_NUM_THREADS", "")
    return int(limit) if limit.isdecimal() and int(limit) > 0 else len(os.sched_getaffinity(0))
