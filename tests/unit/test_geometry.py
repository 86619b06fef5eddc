"""Worlds: collision in cases that can be checked by hand, motion against a readable reference."""

from functools import partial
from typing import TypeAlias

import numpy as np
import pytest

from holdfast.errors import InvalidValueError
from holdfast.numerics.arrays import FloatArray
from holdfast.numerics.geometry import FAR, MAX_NOISE_ATTEMPTS, BoxWorld, DiscWorld, RectangleWorld
from holdfast.numerics.randomness import Purpose, Stream, stream

World = DiscWorld | RectangleWorld | BoxWorld

fresh = partial(stream, 20, 1, 2, Purpose.PREDICTION)  # anew at each call
GROUND = [(-FAR, -FAR, FAR, 0.0)]
SLOT = [(-FAR, -FAR, -0.6, 0.0), (0.6, -FAR, FAR, 0.0), (-0.6, -FAR, 0.6, -1.1)]
SLOT_3D = [
    (-FAR, -FAR, -FAR, -0.6, FAR, 0.0),
    (0.6, -FAR, -FAR, FAR, FAR, 0.0),
    (-0.6, -FAR, -FAR, 0.6, -0.6, 0.0),
    (-0.6, 0.6, -FAR, 0.6, FAR, 0.0),
    (-0.6, -0.6, -FAR, 0.6, 0.6, -1.1),
]


def collides(world: World, *state: float) -> bool:
    return bool(world.collides(np.array(state)))


DISC = DiscWorld(0.5, [(0.0, 0.0, 2.0, 1.0)])
STANDING = RectangleWorld(1.0, 2.0, GROUND)
BRICK = BoxWorld((1.0, 2.0, 3.0), [(-9.0, -9.0, -9.0, 9.0, 9.0, 0.0)])


@pytest.mark.parametrize(
    ("world", "free", "colliding"),
    [
        (DISC, (1.0, 1.51), (1.0, 1.49)),  # beside an edge
        (DISC, (2.4, 1.4), (2.3, 1.3)),  # at a corner: at distances 0.566 and 0.424
        (DISC, (1.0, 1.5), (1.0, 0.5)),  # touching; with its centre inside
        (DISC, (-0.5, 0.5), (-0.5 + 1e-9, 0.5)),
        (STANDING, (123.0, 1.0, 0.0), (123.0, 1.0 - 1e-9, 0.0)),
        (BRICK, (0.0, 0.0, 1.5, 0.0, 0.0, 0.0), (0.0, 0.0, 1.5 - 1e-9, 0.0, 0.0, 0.0)),
    ],
)
def test_touching_is_free(
    world: World, free: tuple[float, ...], colliding: tuple[float, ...]
) -> None:
    assert not collides(world, *free)
    assert collides(world, *colliding)


def test_parallel_edges_separate_nothing() -> None:
    # Without care, the cross product of parallel edges is a zero axis that "separates" all.
    world = BoxWorld((1.0, 1.0, 1.0), [(-1.0, -1.0, -1.0, 1.0, 1.0, 1.0)])
    for angles in np.eye(3) * 0.7:
        assert collides(world, 0.3, 0.2, 0.1, *angles)


def reference_move(
    world: World,
    states: FloatArray,
    actions: FloatArray,
    deviation: FloatArray,
    tolerance: float,
    source: Stream,
) -> FloatArray:
    """Say in the plainest way what ``move`` does."""
    result = np.empty_like(states)
    noise: list[FloatArray] = []
    for n, (state, action) in enumerate(zip(states, actions, strict=True)):
        stopped = state + action
        if world.collides(stopped):
            low, high = 0.0, 1.0
            while high - low > tolerance:
                middle = (low + high) / 2
                if world.collides(state + middle * action):
                    high = middle
                else:
                    low = middle
            stopped = state + low * action
        result[n] = stopped
        for attempt in range(MAX_NOISE_ATTEMPTS):
            if attempt == len(noise):
                noise.append(source.substream(attempt).normal(states.shape))
            candidate = stopped + deviation * noise[attempt][n]
            if not world.collides(candidate):
                result[n] = candidate
                break
    return result


Case: TypeAlias = tuple[World, FloatArray, FloatArray, FloatArray]
WORLDS: dict[str, Case] = {
    "disc": (
        DiscWorld(0.1, [(-FAR, -FAR, FAR, 0.0), (0.0, 0.0, 0.1, 5.0)]),
        np.array([-0.15, 0.15]),
        np.array([0.05, 0.05]),
        np.array([0.1, -0.1]),
    ),
    "rectangle": (
        RectangleWorld(1.0, 2.0, SLOT),
        np.array([0.0, 0.0, 0.0]),
        np.array([0.1, 0.1, 0.1]),
        np.array([0.05, -0.1, 0.05]),
    ),
    "box": (
        BoxWorld((1.0, 1.0, 2.0), SLOT_3D),
        np.zeros(6),
        np.full(6, 0.05),
        np.array([0.05, 0.0, -0.1, 0.05, 0.0, 0.02]),
    ),
}


@pytest.fixture(params=WORLDS)
def case(request: pytest.FixtureRequest) -> Case:
    return WORLDS[request.param]


class TestMove:
    def test_equals_the_reference_bit_for_bit(self, case: Case) -> None:
        world, mean, deviation, action = case
        states, unplaced = world.draw_free(mean, deviation, 60, fresh().substream(9))
        assert unplaced == 0
        actions = action * (1.0 + fresh().substream(8).normal(states.shape))
        assert 5 < world.collides(states + actions).sum() < 60  # some stop, some do not
        moved = world.move(states, actions, deviation, 1e-3, fresh())
        expected = reference_move(world, states, actions, deviation, 1e-3, fresh())
        assert moved.tobytes() == expected.tobytes()

    def test_a_particle_does_not_depend_on_the_others_or_on_threads(self, case: Case) -> None:
        world, mean, deviation, action = case
        count = 5000  # above the kernel's threshold for threads
        states, _ = world.draw_free(mean, deviation, count, fresh())
        few, _ = world.draw_free(mean, deviation, 300, fresh())
        assert states[:300].tobytes() == few.tobytes()
        moved = world.move(states, action, deviation, 1e-3, fresh())
        fewer = world.move(states[:300], action, deviation, 1e-3, fresh())
        assert moved[:300].tobytes() == fewer.tobytes()

    def test_a_tiny_tolerance_ends(self) -> None:
        world = DiscWorld(0.1, GROUND)
        moved = world.move(
            np.array([0.0, 0.5]), np.array([0.0, -1.0]), np.zeros(2), 1e-300, fresh()
        )
        assert moved[1] == pytest.approx(0.1, abs=1e-15)

    def test_where_no_noise_fits_there_is_none(self) -> None:
        cage = [
            (-FAR, -FAR, -0.1, FAR),
            (0.1, -FAR, FAR, FAR),
            (-FAR, -FAR, FAR, -0.1),
            (-FAR, 0.1, FAR, FAR),
        ]
        world = DiscWorld(0.099, cage)
        moved = world.move(np.zeros(2), np.array([0.0005, 0.0]), np.full(2, 4.0), 1e-3, fresh())
        np.testing.assert_array_equal(moved, [0.0005, 0.0])

    def test_a_start_in_collision_without_a_way_out_stays(self) -> None:
        world = DiscWorld(0.1, GROUND)
        state = np.array([0.0, -50.0])
        moved = world.move(state, np.array([0.1, 0.1]), np.full(2, 0.1), 1e-3, fresh())
        np.testing.assert_array_equal(moved, state)

    def test_inputs_are_not_changed(self) -> None:
        world = DiscWorld(0.1, GROUND)
        states, actions = np.full((4, 2), 1.0), np.full((4, 2), 0.1)
        world.move(states, actions, np.full(2, 0.1), 1e-3, fresh())
        assert (states == 1.0).all()
        assert (actions == 0.1).all()

    @pytest.mark.parametrize(
        ("states", "actions", "result"),
        [
            ((2,), (2,), (2,)),
            ((7, 2), (2,), (7, 2)),
            ((7, 2), (1, 2), (7, 2)),
            ((3, 7, 2), (3, 7, 2), (3, 7, 2)),
            ((3, 7, 2), (3, 1, 2), (3, 7, 2)),
            ((2,), (5, 2), (5, 2)),
            ((0, 2), (2,), (0, 2)),
        ],
    )
    def test_shapes_broadcast(
        self, states: tuple[int, ...], actions: tuple[int, ...], result: tuple[int, ...]
    ) -> None:
        world = DiscWorld(0.1, GROUND)
        state_values = 10.0 + fresh().normal(states)
        action_values = fresh().substream(1).normal(actions)
        moved = world.move(state_values, action_values, np.zeros(2), 1e-3, fresh())
        np.testing.assert_array_equal(moved, state_values + action_values)
        assert moved.shape == result

    def test_arrays_in_any_memory_order(self) -> None:
        world = RectangleWorld(1.0, 2.0, SLOT)
        states = np.array([0.0, 3.0, 0.0]) + 0.1 * fresh().normal((50, 3))
        action, deviation = np.full(3, -0.1), np.full(3, 0.1)
        expected = world.move(states, action, deviation, 1e-3, fresh())
        strided = np.asfortranarray(states)
        moved = world.move(strided, action, deviation, 1e-3, fresh())
        assert moved.tobytes() == expected.tobytes()


class TestDrawFree:
    def test_takes_the_first_free_draw(self) -> None:
        world = RectangleWorld(1.0, 2.0, GROUND)
        mean, deviation = np.array([0.0, 1.2, 0.0]), np.array([1.0, 1.0, 1.0])
        states, unplaced = world.draw_free(mean, deviation, 40, fresh())
        assert unplaced == 0
        draws = np.array(
            [mean + deviation * fresh().substream(a).normal((40, 3)) for a in range(30)]
        )
        free = ~world.collides(draws)
        assert free.any(axis=0).all()
        assert not free[0].all()
        np.testing.assert_array_equal(states, draws[free.argmax(axis=0), np.arange(40)])

    def test_counts_what_it_cannot_place(self) -> None:
        world = DiscWorld(0.1, GROUND)
        states, unplaced = world.draw_free(np.array([0.0, -9.0]), np.full(2, 0.1), 17, fresh())
        assert unplaced == 17
        np.testing.assert_array_equal(states, np.tile([0.0, -9.0], (17, 1)))

    def test_none(self) -> None:
        states, unplaced = DiscWorld(0.1, GROUND).draw_free(np.ones(2), np.ones(2), 0, fresh())
        assert states.shape == (0, 2)
        assert unplaced == 0


class TestRefusals:
    world = DiscWorld(0.1, GROUND)

    @pytest.mark.parametrize("bad", [np.nan, np.inf, -np.inf])
    def test_values_that_are_not_finite(self, bad: float) -> None:
        good, wrong = np.ones((3, 2)), np.ones((3, 2))
        wrong[1, 0] = bad
        deviation = np.ones(2)
        with pytest.raises(InvalidValueError, match=r"states\[1, 0\]"):
            self.world.collides(wrong)
        with pytest.raises(InvalidValueError, match=r"states\[1, 0\]"):
            self.world.move(wrong, good, deviation, 1e-3, fresh())
        with pytest.raises(InvalidValueError, match=r"actions\[1, 0\]"):
            self.world.move(good, wrong, deviation, 1e-3, fresh())
        with pytest.raises(InvalidValueError, match=r"standard_deviation\[1\]"):
            self.world.move(good, good, np.array([1.0, bad]), 1e-3, fresh())
        with pytest.raises(InvalidValueError, match=r"mean\[0\]"):
            self.world.draw_free(np.array([bad, 1.0]), deviation, 3, fresh())

    @pytest.mark.parametrize("tolerance", [0.0, -1.0, 1.0, np.nan])
    def test_tolerance(self, tolerance: float) -> None:
        with pytest.raises(InvalidValueError, match="tolerance"):
            self.world.move(np.ones(2), np.ones(2), np.ones(2), tolerance, fresh())

    def test_negative_deviation(self) -> None:
        with pytest.raises(InvalidValueError, match="must not be negative"):
            self.world.move(np.ones(2), np.ones(2), np.array([1.0, -1.0]), 1e-3, fresh())
        with pytest.raises(InvalidValueError, match="must not be negative"):
            self.world.draw_free(np.ones(2), np.array([1.0, -1.0]), 3, fresh())

    def test_shapes(self) -> None:
        with pytest.raises(InvalidValueError, match=r"shape \(3, 4\)"):
            self.world.collides(np.ones((3, 4)))
        with pytest.raises(InvalidValueError, match=r"shape \(3,\)"):
            self.world.move(np.ones((3, 2)), np.ones(3), np.ones(2), 1e-3, fresh())
        with pytest.raises(InvalidValueError, match="does not broadcast"):
            self.world.move(np.ones((3, 2)), np.ones((4, 2)), np.ones(2), 1e-3, fresh())
        for states, actions in (((3, 2), (3, 2)), ((4, 5, 2), (3, 2)), ((3, 5, 2), (4, 2))):
            with pytest.raises(InvalidValueError, match=r"must be \(3, n, 2\) and \(3, 2\)"):
                self.world.move_each(
                    np.ones(states), np.ones(actions), np.ones(2), 1e-3, [fresh()] * 3, 1
                )
        with pytest.raises(InvalidValueError, match="standard_deviation"):
            self.world.move(np.ones((3, 2)), np.ones(2), np.ones(3), 1e-3, fresh())
        with pytest.raises(InvalidValueError, match="mean"):
            self.world.draw_free(np.ones(3), np.ones(2), 3, fresh())
        with pytest.raises(InvalidValueError, match="count: -1"):
            self.world.draw_free(np.ones(2), np.ones(2), -1, fresh())

    @pytest.mark.parametrize("size", [0.0, -1.0, np.nan, np.inf])
    def test_sizes(self, size: float) -> None:
        with pytest.raises(InvalidValueError, match="radius"):
            DiscWorld(size, GROUND)
        with pytest.raises(InvalidValueError, match="height"):
            RectangleWorld(1.0, size, GROUND)
        with pytest.raises(InvalidValueError, match=r"size\[2\]"):
            BoxWorld((1.0, 1.0, size), SLOT_3D)

    @pytest.mark.parametrize(
        "obstacles", [[(0, 0, 1)], [(0, 0, 0, 1)], [(0, 2, 1, 1)], [(0, 0, np.inf, 1)]]
    )
    def test_obstacles(self, obstacles: list[tuple[float, ...]]) -> None:
        with pytest.raises(InvalidValueError, match="obstacles"):
            DiscWorld(1.0, obstacles)

    def test_no_obstacles(self) -> None:
        assert not DiscWorld(1.0, []).collides(np.zeros((5, 2))).any()
