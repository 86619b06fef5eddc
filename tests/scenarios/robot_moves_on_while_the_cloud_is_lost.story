# The cloud dies while the robot moves, and the local service does not come up soon. The robot moves
# on to its next sensing step, and holds still only there.
run what=sensing launch_s=0.3
crash service=cloud-1 at=0.05 down_s=3600
----
   0.0000  cloud-1  starts, process 1
   0.0010  robot    begins trial 0 at step 0
   0.0100  robot    service_appeared service=cloud-1
   0.0100  robot    asks cloud-1, call 1
   0.0150  robot    hears of call 1: SensingAnswer
   0.0150  robot    performs sensing action 0 of step 0
   0.0150  robot    hears of call 1: its end
   0.0160  robot    asks cloud-1, call 2
   0.0160  robot    performs task action 0
   0.0190  robot    hears of call 2: TaskAnswer
   0.0220  robot    hears of call 2: SensingAnswer
   0.0220  robot    hears of call 2: its end
   0.0262  robot    performs task actions 1 to 3
   0.0500  cloud-1  is killed
   0.0520  robot    service_vanished service=cloud-1
   0.0520  robot    status from=standard to=local_recovery silent_ms=30 reason=cloud-1 is gone
   0.0520  robot    launch service=local
   0.0520  local    is launched
   0.0568  robot    performs task actions 4 to 8
   0.1078  robot    performs sensing action 0 of step 9
   0.1088  robot    performs task actions 9 to 17
   0.2006  robot    holding step=9 reason=cloud-1: is not there; local: is being launched
   0.3520  local    starts, process 1
   0.3620  robot    launched launch_ms=310
   0.3620  robot    restore service=local step=9 bytes=1575
   0.3620  robot    asks local, call 3
   0.3632  robot    hears of call 3: TaskAnswer
   0.3632  robot    restored service=local step=9 restore_ms=1.2
   0.3632  robot    resumed held_ms=162.6
   0.3662  robot    hears of call 3: SensingAnswer
   0.3662  robot    performs sensing action 0 of step 18
   0.3662  robot    hears of call 3: its end
   0.3672  robot    asks local, call 4
   0.3672  robot    performs task action 18
   0.3684  robot    hears of call 4: TaskAnswer
   0.3714  robot    hears of call 4: SensingAnswer
   0.3714  robot    hears of call 4: its end
   0.3774  robot    performs task actions 19 to 26
   0.4590  robot    performs sensing action 0 of step 27
   0.4600  robot    asks local, call 5
   0.4600  robot    performs task action 27
   0.4612  robot    hears of call 5: TaskAnswer
   0.4642  robot    hears of call 5: SensingAnswer
   0.4642  robot    hears of call 5: its end
   0.4702  robot    performs task actions 28 to 35
   0.5518  robot    performs sensing action 2 of step 36
   0.5528  robot    unexplained trial=0 step=36 sensing_action=2 deviations=41.5642 reason=more than 8 standard deviations from every particle
   0.5528  robot    asks local, call 6
   0.5528  robot    performs task action 36
   0.5540  robot    hears of call 6: TaskAnswer
   0.5570  robot    hears of call 6: SensingAnswer
   0.5570  robot    hears of call 6: its end
   0.5630  robot    performs task actions 37 to 39
   0.5936  robot    ends trial 0 after 40 steps

decided as without faults
