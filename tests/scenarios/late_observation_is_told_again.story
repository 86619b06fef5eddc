# The same, but the environment tells it again; after the second end, also what the journal has.
run remembers=true
late step=0 moves=4
kill_robot at=0.055 down_s=0.05
kill_robot at=0.3 down_s=0.05
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
   0.0498  robot    is shown what was sensed in step 0
   0.0550  robot    is killed
   0.1050  robot    is started again
   0.1060  robot    begins trial 0 at step 3
   0.1060  robot    is shown what was sensed in step 0
   0.1060  robot    resumed_trial trial=0 step=3
   0.1060  robot    performed_unseen trial=0 step=3
   0.1150  robot    service_appeared service=cloud-1
   0.1150  robot    restore service=cloud-1 step=4 bytes=1575
   0.1150  robot    asks cloud-1, call 1
   0.1180  robot    hears of call 1: TaskAnswer
   0.1180  robot    restored service=cloud-1 step=4 restore_ms=3
   0.1180  robot    performs task action 4
   0.1210  robot    hears of call 1: SensingAnswer
   0.1210  robot    hears of call 1: its end
   0.1282  robot    performs task actions 5 to 8
   0.1690  robot    performs sensing action 0 of step 9
   0.1700  robot    asks cloud-1, call 2
   0.1730  robot    hears of call 2: TaskAnswer
   0.1730  robot    performs task action 9
   0.1760  robot    hears of call 2: SensingAnswer
   0.1760  robot    hears of call 2: its end
   0.1832  robot    performs task actions 10 to 17
   0.2648  robot    performs sensing action 0 of step 18
   0.2658  robot    asks cloud-1, call 3
   0.2688  robot    hears of call 3: TaskAnswer
   0.2688  robot    performs task action 18
   0.2718  robot    hears of call 3: SensingAnswer
   0.2718  robot    hears of call 3: its end
   0.2790  robot    performs task actions 19 to 21
   0.3000  robot    is killed
   0.3500  robot    is started again
   0.3510  robot    begins trial 0 at step 21
   0.3510  robot    is shown what was sensed in step 0
   0.3510  robot    resumed_trial trial=0 step=21
   0.3510  robot    performed_unseen trial=0 step=21
   0.3510  robot    late_unused trial=0 step=22 taken=0 reason=no observation of that step is awaited: it has come before, was given up, or nothing was sensed there
   0.3600  robot    service_appeared service=cloud-1
   0.3600  robot    restore service=cloud-1 step=22 bytes=1575
   0.3600  robot    asks cloud-1, call 1
   0.3630  robot    hears of call 1: TaskAnswer
   0.3630  robot    restored service=cloud-1 step=22 restore_ms=3
   0.3630  robot    performs task action 22
   0.3630  robot    hears of call 1: SensingAnswer
   0.3630  robot    hears of call 1: its end
   0.3732  robot    performs task actions 23 to 26
   0.4140  robot    performs sensing action 0 of step 27
   0.4150  robot    asks cloud-1, call 2
   0.4180  robot    hears of call 2: TaskAnswer
   0.4180  robot    performs task action 27
   0.4210  robot    hears of call 2: SensingAnswer
   0.4210  robot    hears of call 2: its end
   0.4282  robot    performs task actions 28 to 35
   0.5098  robot    performs sensing action 2 of step 36
   0.5108  robot    unexplained trial=0 step=36 sensing_action=2 deviations=41.5642 reason=more than 8 standard deviations from every particle
   0.5108  robot    asks cloud-1, call 3
   0.5138  robot    hears of call 3: TaskAnswer
   0.5138  robot    performs task action 36
   0.5168  robot    hears of call 3: SensingAnswer
   0.5168  robot    hears of call 3: its end
   0.5240  robot    performs task actions 37 to 39
   0.5546  robot    ends trial 0 after 40 steps

decided as without faults
