# As before, but nobody can say whether the body has moved. The robot holds still: an action must
# never be performed twice.
run environment=not_counting
kill_robot boundary=18
----
   0.0000  cloud-1  starts, process 1
   0.0010  robot    begins trial 0 at step 0
   0.0100  robot    service_appeared service=cloud-1
   0.0100  robot    asks cloud-1, call 1
   0.0150  robot    hears of call 1: SensingAnswer
   0.0150  robot    performs sensing action 0 of step 0
   0.0150  robot    hears of call 1: its end
   0.0160  robot    asks cloud-1, call 2
   0.0190  robot    hears of call 2: TaskAnswer
   0.0190  robot    performs task action 0
   0.0220  robot    hears of call 2: SensingAnswer
   0.0220  robot    hears of call 2: its end
   0.0292  robot    performs task actions 1 to 6
   0.0904  robot    is killed
   0.2904  robot    is started again
   0.2914  robot    begins trial 0 at step 6
   0.2914  robot    resumed_trial trial=0 step=6

the robot holds still: trial 0, step 6: the journal ends with a task action and does not say whether it was performed, and the environment has no method steps_performed that could tell; nothing is performed, because it must never be performed twice. Begin that trial anew in another directory (--out)
