"""Problems as gymnasium environments in worker processes, as learning on several cores has them."""

from typing import Any

import gymnasium
import numpy as np
import pytest

ARGUMENTS: dict[str, Any] = {
    "num_envs": 2,
    "problem": "peg_in_hole_2d",
    "particles": 40,
    "max_steps": 60,
}


@pytest.mark.parametrize("context", ["fork", "spawn"])
def test_workers_show_what_one_process_shows(context: str) -> None:
    shown = []
    for mode, vector_kwargs in (("sync", {}), ("async", {"context": context})):
        vector = gymnasium.make_vec(
            "holdfast_env:Problem-v0",
            vectorization_mode=mode,
            vector_kwargs=vector_kwargs,
            **ARGUMENTS,
        )
        vector.action_space.seed(1)
        rows = [vector.reset(seed=4)[0].copy()]
        for _ in range(9):  # past the end of an episode, which then begins again
            row, *_ = vector.step(vector.action_space.sample())
            rows.append(row.copy())
        vector.close()
        shown.append(np.array(rows))
    assert np.array_equal(shown[0], shown[1])
