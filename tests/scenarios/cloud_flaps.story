# The cloud dies, comes back and dies again, three times. The local service is launched once and kept.
run
crash service=cloud-1 at=0.1 down_s=0.08
crash service=cloud-1 at=0.25 down_s=0.08
crash service=cloud-1 at=0.4 down_s=0.08
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
   0.0292  robot    performs task actions 1 to 7
   0.1000  cloud-1  is killed
   0.1006  robot    performs task action 8
   0.1020  robot    service_vanished service=cloud-1
   0.1020  robot    status from=standard to=local_recovery silent_ms=80 reason=cloud-1 is gone
   0.1020  robot    launch service=local
   0.1020  local    is launched
   0.1108  robot    performs sensing action 0 of step 9
   0.1118  robot    holding step=9 reason=cloud-1: is not there; local: is being launched
   0.1800  cloud-1  starts, process 2
   0.1900  robot    service_appeared service=cloud-1
   0.1900  robot    restore service=cloud-1 step=9 bytes=1575
   0.1900  robot    asks cloud-1, call 3
   0.1930  robot    hears of call 3: TaskAnswer
   0.1930  robot    restored service=cloud-1 step=9 restore_ms=3
   0.1930  robot    resumed held_ms=81.2
   0.1930  robot    status from=local_recovery to=keep_alive outage_ms=91 reason=cloud-1 has answered
   0.1930  robot    performs task action 9
   0.1960  robot    hears of call 3: SensingAnswer
   0.1960  robot    hears of call 3: its end
   0.2032  robot    performs task actions 10 to 14
   0.2500  cloud-1  is killed
   0.2520  local    starts, process 1
   0.2520  robot    service_vanished service=cloud-1
   0.2520  robot    status from=keep_alive to=local_recovery silent_ms=56 reason=cloud-1 is gone
   0.2542  robot    performs task action 15
   0.2620  robot    launched launch_ms=160
   0.2644  robot    performs task actions 16 to 17
   0.2848  robot    performs sensing action 0 of step 18
   0.2858  robot    restore service=local step=18 bytes=1575
   0.2858  robot    asks local, call 4
   0.2870  robot    hears of call 4: TaskAnswer
   0.2870  robot    restored service=local step=18 restore_ms=1.2
   0.2870  robot    performs task action 18
   0.2900  robot    hears of call 4: SensingAnswer
   0.2900  robot    hears of call 4: its end
   0.2972  robot    performs task actions 19 to 22
   0.3300  cloud-1  starts, process 3
   0.3380  robot    performs task action 23
   0.3400  robot    service_appeared service=cloud-1
   0.3400  robot    restore service=cloud-1 step=18 bytes=1575
   0.3400  robot    asks cloud-1, call 5
   0.3430  robot    hears of call 5: TaskAnswer
   0.3430  robot    restored service=cloud-1 step=18 restore_ms=3
   0.3430  robot    status from=local_recovery to=keep_alive outage_ms=91 reason=cloud-1 has answered
   0.3460  robot    hears of call 5: SensingAnswer
   0.3460  robot    hears of call 5: its end
   0.3482  robot    performs task actions 24 to 26
   0.3788  robot    performs sensing action 0 of step 27
   0.3798  robot    asks cloud-1, call 6
   0.3828  robot    hears of call 6: TaskAnswer
   0.3828  robot    performs task action 27
   0.3858  robot    hears of call 6: SensingAnswer
   0.3858  robot    hears of call 6: its end
   0.3930  robot    performs task action 28
   0.4000  cloud-1  is killed
   0.4020  robot    service_vanished service=cloud-1
   0.4020  robot    status from=keep_alive to=local_recovery silent_ms=16.2 reason=cloud-1 is gone
   0.4032  robot    performs task actions 29 to 35
   0.4746  robot    performs sensing action 2 of step 36
   0.4756  robot    unexplained trial=0 step=36 sensing_action=2 deviations=41.5642 reason=more than 8 standard deviations from every particle
   0.4756  robot    asks local, call 7
   0.4768  robot    hears of call 7: TaskAnswer
   0.4768  robot    performs task action 36
   0.4798  robot    hears of call 7: SensingAnswer
   0.4798  robot    hears of call 7: its end
   0.4800  cloud-1  starts, process 4
   0.4870  robot    performs task action 37
   0.4900  robot    service_appeared service=cloud-1
   0.4900  robot    restore service=cloud-1 step=36 bytes=1575
   0.4900  robot    asks cloud-1, call 8
   0.4930  robot    hears of call 8: TaskAnswer
   0.4930  robot    restored service=cloud-1 step=36 restore_ms=3
   0.4930  robot    status from=local_recovery to=keep_alive outage_ms=91 reason=cloud-1 has answered
   0.4960  robot    hears of call 8: SensingAnswer
   0.4960  robot    hears of call 8: its end
   0.4972  robot    performs task actions 38 to 39
   0.5176  robot    ends trial 0 after 40 steps

decided as without faults
