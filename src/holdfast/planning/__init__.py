"""Planning: a deterministic state machine, and all that it chooses by.

:mod:`planner` has the state and the pure functions over it; :mod:`belief`, :mod:`estimators` and
:mod:`sensing` are how a sensing action is chosen, :mod:`policy_path` and :mod:`expected_return`
how far it looks ahead; :mod:`validation_gate` and :mod:`lost` find out when a belief is wrong.
:mod:`tracking` folds what was done and sensed into a state, :mod:`outcome` is what a trial came to.
"""
