# The robot dies before it has written down what came late, and nobody tells it again. So it was never
# seen, and the trial is one without it.
run
late step=0 moves=4
kill_robot at=0.055 down_s=0.05
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
   0.1060  robot    resumed_trial trial=0 step=3
   0.1060  robot    performed_unseen trial=0 step=3
   0.1150  robot    service_appeared service=cloud-1
   0.1150  robot    restore service=cloud-1 step=4 bytes=1575
   0.1150  robot    asks cloud-1, call 1
   0.1180  robot    hears of call 1: TaskAnswer
   0.1180  robot    restored service=cloud-1 step=4 restore_ms=3
   0.1180  robot    performs task action 4
   0.1180  robot    hears of call 1: SensingAnswer
   0.1180  robot    hears of call 1: its end
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
   0.2790  robot    performs task actions 19 to 26
   0.3606  robot    performs sensing action 0 of step 27
   0.3616  robot    asks cloud-1, call 4
   0.3646  robot    hears of call 4: TaskAnswer
   0.3646  robot    performs task action 27
   0.3676  robot    hears of call 4: SensingAnswer
   0.3676  robot    hears of call 4: its end
   0.3748  robot    performs task actions 28 to 35
   0.4564  robot    performs sensing action 0 of step 36
   0.4574  robot    asks cloud-1, call 5
   0.4604  robot    hears of call 5: TaskAnswer
   0.4604  robot    performs task action 36
   0.4634  robot    hears of call 5: SensingAnswer
   0.4634  robot    hears of call 5: its end
   0.4706  robot    performs task actions 37 to 39
   0.5012  robot    ends trial 0 after 40 steps

decided as without faults
