# Two services: the second takes over when the first dies, and the first one is used again when it is
# back. The local service is never needed.
run replicas=2
crash service=cloud-1 at=0.1 down_s=0.1
----
   0.0000  cloud-1  starts, process 1
   0.0000  cloud-2  starts, process 1
   0.0010  robot    begins trial 0 at step 0
   0.0100  robot    service_appeared service=cloud-1
   0.0100  robot    asks cloud-1, call 1
   0.0100  robot    service_appeared service=cloud-2
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
   0.1108  robot    performs sensing action 0 of step 9
   0.1118  robot    restore service=cloud-2 step=9 bytes=1575
   0.1118  robot    asks cloud-2, call 3
   0.1148  robot    hears of call 3: TaskAnswer
   0.1148  robot    restored service=cloud-2 step=9 restore_ms=3
   0.1148  robot    performs task action 9
   0.1178  robot    hears of call 3: SensingAnswer
   0.1178  robot    hears of call 3: its end
   0.1250  robot    performs task actions 10 to 17
   0.2000  cloud-1  starts, process 2
   0.2066  robot    performs sensing action 0 of step 18
   0.2076  robot    asks cloud-2, call 4
   0.2100  robot    service_appeared service=cloud-1
   0.2106  robot    hears of call 4: TaskAnswer
   0.2106  robot    performs task action 18
   0.2136  robot    hears of call 4: SensingAnswer
   0.2136  robot    hears of call 4: its end
   0.2208  robot    performs task actions 19 to 26
   0.3024  robot    performs sensing action 0 of step 27
   0.3034  robot    restore service=cloud-1 step=27 bytes=1575
   0.3034  robot    asks cloud-1, call 5
   0.3064  robot    hears of call 5: TaskAnswer
   0.3064  robot    restored service=cloud-1 step=27 restore_ms=3
   0.3064  robot    performs task action 27
   0.3094  robot    hears of call 5: SensingAnswer
   0.3094  robot    hears of call 5: its end
   0.3166  robot    performs task actions 28 to 35
   0.3982  robot    performs sensing action 2 of step 36
   0.3992  robot    unexplained trial=0 step=36 sensing_action=2 deviations=41.5642 reason=more than 8 standard deviations from every particle
   0.3992  robot    asks cloud-1, call 6
   0.4022  robot    hears of call 6: TaskAnswer
   0.4022  robot    performs task action 36
   0.4052  robot    hears of call 6: SensingAnswer
   0.4052  robot    hears of call 6: its end
   0.4124  robot    performs task actions 37 to 39
   0.4430  robot    ends trial 0 after 40 steps

decided as without faults
