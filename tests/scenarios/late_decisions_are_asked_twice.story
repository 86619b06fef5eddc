# The cloud is slow and there is a deadline: late decisions are asked of the local service too.
run launch=at_start launch_s=0.02 deadline_ms=5 sensing_s=0.01
slow service=cloud-1 at=0.05 for_s=0.25 factor=20
----
   0.0000  cloud-1  starts, process 1
   0.0000  robot    launch service=local
   0.0000  local    is launched
   0.0010  robot    begins trial 0 at step 0
   0.0100  robot    service_appeared service=cloud-1
   0.0100  robot    asks cloud-1, call 1
   0.0200  local    starts, process 1
   0.0220  robot    hears of call 1: SensingAnswer
   0.0220  robot    performs sensing action 0 of step 0
   0.0220  robot    hears of call 1: its end
   0.0230  robot    asks cloud-1, call 2
   0.0260  robot    hears of call 2: TaskAnswer
   0.0260  robot    performs task action 0
   0.0300  robot    launched launch_ms=30
   0.0360  robot    hears of call 2: SensingAnswer
   0.0360  robot    hears of call 2: its end
   0.0362  robot    performs task actions 1 to 2
   0.0500  cloud-1  computes 20 times as long
   0.0566  robot    performs task actions 3 to 8
   0.1178  robot    performs sensing action 0 of step 9
   0.1188  robot    asks cloud-1, call 3
   0.1238  robot    hedge step=9 waited_ms=5
   0.1238  robot    restore service=local step=9 bytes=1575
   0.1238  robot    asks local, call 4
   0.1250  robot    hears of call 4: TaskAnswer
   0.1250  robot    restored service=local step=9 restore_ms=1.2
   0.1250  robot    performs task action 9
   0.1350  robot    hears of call 4: SensingAnswer
   0.1350  robot    hears of call 4: its end
   0.1352  robot    performs task actions 10 to 11
   0.1508  robot    hears of call 3: TaskAnswer
   0.1556  robot    performs task actions 12 to 16
   0.2008  robot    hears of call 3: Progress
   0.2066  robot    performs task action 17
   0.2168  robot    performs sensing action 0 of step 18
   0.2178  robot    asks cloud-1, call 5
   0.2228  robot    hedge step=18 waited_ms=5
   0.2228  robot    asks local, call 6
   0.2240  robot    hears of call 6: TaskAnswer
   0.2240  robot    performs task action 18
   0.2340  robot    hears of call 6: SensingAnswer
   0.2340  robot    hears of call 6: its end
   0.2342  robot    performs task action 19
   0.2398  robot    hears of call 5: TaskAnswer
   0.2444  robot    performs task actions 20 to 24
   0.2898  robot    hears of call 5: Progress
   0.2954  robot    performs task actions 25 to 26
   0.3158  robot    performs sensing action 0 of step 27
   0.3168  robot    asks cloud-1, call 7
   0.3198  robot    hears of call 7: TaskAnswer
   0.3198  robot    performs task actions 27 to 31
   0.3608  robot    hears of call 7: SensingAnswer
   0.3608  robot    hears of call 7: its end
   0.3708  robot    performs task actions 32 to 35
   0.4116  robot    performs sensing action 2 of step 36
   0.4126  robot    unexplained trial=0 step=36 sensing_action=2 deviations=41.5642 reason=more than 8 standard deviations from every particle
   0.4126  robot    asks cloud-1, call 8
   0.4156  robot    hears of call 8: TaskAnswer
   0.4156  robot    performs task action 36
   0.4256  robot    hears of call 8: SensingAnswer
   0.4256  robot    hears of call 8: its end
   0.4258  robot    performs task actions 37 to 39
   0.4564  robot    ends trial 0 after 40 steps

decided as without faults
