# The robot's process is killed between the note of a task action and its performance. The next
# process asks the robot's body, which has not moved, and performs the action then.
run
kill_robot boundary=19
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
   0.2914  robot    begins trial 0 at step 7
   0.2914  robot    resumed_trial trial=0 step=7
   0.2914  robot    performs task action 7
   0.3004  robot    service_appeared service=cloud-1
   0.3016  robot    restore service=cloud-1 step=8 bytes=1575
   0.3016  robot    asks cloud-1, call 1
   0.3046  robot    hears of call 1: TaskAnswer
   0.3046  robot    restored service=cloud-1 step=8 restore_ms=3
   0.3046  robot    performs task action 8
   0.3046  robot    hears of call 1: SensingAnswer
   0.3046  robot    hears of call 1: its end
   0.3148  robot    performs sensing action 0 of step 9
   0.3158  robot    asks cloud-1, call 2
   0.3188  robot    hears of call 2: TaskAnswer
   0.3188  robot    performs task action 9
   0.3218  robot    hears of call 2: SensingAnswer
   0.3218  robot    hears of call 2: its end
   0.3290  robot    performs task actions 10 to 17
   0.4106  robot    performs sensing action 0 of step 18
   0.4116  robot    asks cloud-1, call 3
   0.4146  robot    hears of call 3: TaskAnswer
   0.4146  robot    performs task action 18
   0.4176  robot    hears of call 3: SensingAnswer
   0.4176  robot    hears of call 3: its end
   0.4248  robot    performs task actions 19 to 26
   0.5064  robot    performs sensing action 0 of step 27
   0.5074  robot    asks cloud-1, call 4
   0.5104  robot    hears of call 4: TaskAnswer
   0.5104  robot    performs task action 27
   0.5134  robot    hears of call 4: SensingAnswer
   0.5134  robot    hears of call 4: its end
   0.5206  robot    performs task actions 28 to 35
   0.6022  robot    performs sensing action 2 of step 36
   0.6032  robot    unexplained trial=0 step=36 sensing_action=2 deviations=41.5642 reason=more than 8 standard deviations from every particle
   0.6032  robot    asks cloud-1, call 5
   0.6062  robot    hears of call 5: TaskAnswer
   0.6062  robot    performs task action 36
   0.6092  robot    hears of call 5: SensingAnswer
   0.6092  robot    hears of call 5: its end
   0.6164  robot    performs task actions 37 to 39
   0.6470  robot    ends trial 0 after 40 steps

decided as without faults
