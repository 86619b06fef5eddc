# Where sensing may be left out, not to sense is an answer like the others: nothing is ordered, and
# the next question follows at once.
run trial=2 sensing_is_optional=true
late step=0 moves=5
----
   0.0000  cloud-1  starts, process 1
   0.0010  robot    begins trial 2 at step 0
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
   0.0292  robot    performs task actions 1 to 4
   0.0600  robot    is shown what was sensed in step 0
   0.0700  robot    asks cloud-1, call 3
   0.0730  robot    hears of call 3: TaskAnswer
   0.0730  robot    performs task action 5
   0.0760  robot    hears of call 3: SensingAnswer
   0.0760  robot    hears of call 3: its end
   0.0832  robot    performs task actions 6 to 8
   0.1138  robot    performs sensing action 0 of step 9
   0.1148  robot    asks cloud-1, call 4
   0.1178  robot    hears of call 4: TaskAnswer
   0.1178  robot    performs task action 9
   0.1208  robot    hears of call 4: SensingAnswer
   0.1208  robot    hears of call 4: its end
   0.1280  robot    performs task actions 10 to 17
   0.2096  robot    performs sensing action 0 of step 18
   0.2106  robot    asks cloud-1, call 5
   0.2136  robot    hears of call 5: TaskAnswer
   0.2136  robot    performs task action 18
   0.2166  robot    hears of call 5: SensingAnswer
   0.2166  robot    hears of call 5: its end
   0.2238  robot    performs task actions 19 to 26
   0.3054  robot    performs sensing action 0 of step 27
   0.3064  robot    asks cloud-1, call 6
   0.3094  robot    hears of call 6: TaskAnswer
   0.3094  robot    performs task action 27
   0.3124  robot    hears of call 6: SensingAnswer
   0.3124  robot    hears of call 6: its end
   0.3196  robot    performs task actions 28 to 35
   0.4012  robot    asks cloud-1, call 7
   0.4042  robot    hears of call 7: TaskAnswer
   0.4042  robot    performs task action 36
   0.4072  robot    hears of call 7: SensingAnswer
   0.4072  robot    hears of call 7: its end
   0.4144  robot    performs task actions 37 to 39
   0.4450  robot    ends trial 2 after 40 steps

decided as without faults
