# Both die at the same time. The robot holds still until the next local service is there.
run
crash service=cloud-1 at=0.05 down_s=3600
crash service=local at=0.3
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
   0.0292  robot    performs task actions 1 to 3
   0.0500  cloud-1  is killed
   0.0520  robot    service_vanished service=cloud-1
   0.0520  robot    status from=standard to=local_recovery silent_ms=30 reason=cloud-1 is gone
   0.0520  robot    launch service=local
   0.0520  local    is launched
   0.0598  robot    performs task actions 4 to 8
   0.1108  robot    performs sensing action 0 of step 9
   0.1118  robot    holding step=9 reason=cloud-1: is not there; local: is being launched
   0.2020  local    starts, process 1
   0.2120  robot    launched launch_ms=160
   0.2120  robot    restore service=local step=9 bytes=1575
   0.2120  robot    asks local, call 3
   0.2132  robot    hears of call 3: TaskAnswer
   0.2132  robot    restored service=local step=9 restore_ms=1.2
   0.2132  robot    resumed held_ms=101.4
   0.2132  robot    performs task action 9
   0.2162  robot    hears of call 3: SensingAnswer
   0.2162  robot    hears of call 3: its end
   0.2234  robot    performs task actions 10 to 17
   0.3000  local    is killed
   0.3010  robot    service_vanished service=local
   0.3010  robot    launch service=local
   0.3010  local    is launched
   0.3020  robot    recovery_exited reason=was ended by SIGKILL
   0.3050  robot    performs sensing action 0 of step 18
   0.3060  robot    holding step=18 reason=cloud-1: is not there; local: is being launched
   0.4510  local    starts, process 2
   0.4610  robot    launched launch_ms=160
   0.4610  robot    restore service=local step=18 bytes=1575
   0.4610  robot    asks local, call 4
   0.4622  robot    hears of call 4: TaskAnswer
   0.4622  robot    restored service=local step=18 restore_ms=1.2
   0.4622  robot    resumed held_ms=156.2
   0.4622  robot    performs task action 18
   0.4652  robot    hears of call 4: SensingAnswer
   0.4652  robot    hears of call 4: its end
   0.4724  robot    performs task actions 19 to 26
   0.5540  robot    performs sensing action 0 of step 27
   0.5550  robot    asks local, call 5
   0.5562  robot    hears of call 5: TaskAnswer
   0.5562  robot    performs task action 27
   0.5592  robot    hears of call 5: SensingAnswer
   0.5592  robot    hears of call 5: its end
   0.5664  robot    performs task actions 28 to 35
   0.6480  robot    performs sensing action 2 of step 36
   0.6490  robot    unexplained trial=0 step=36 sensing_action=2 deviations=41.5642 reason=more than 8 standard deviations from every particle
   0.6490  robot    asks local, call 6
   0.6502  robot    hears of call 6: TaskAnswer
   0.6502  robot    performs task action 36
   0.6532  robot    hears of call 6: SensingAnswer
   0.6532  robot    hears of call 6: its end
   0.6604  robot    performs task actions 37 to 39
   0.6910  robot    ends trial 0 after 40 steps

decided as without faults
