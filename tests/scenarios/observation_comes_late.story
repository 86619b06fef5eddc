# An observation takes twelve moves. The robot goes on with what it knows, and asks anew when it
# comes: the answer that it has is for another state.
run
late step=9 moves=12
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
   0.0292  robot    performs task actions 1 to 8
   0.1108  robot    performs sensing action 0 of step 9
   0.1118  robot    asks cloud-1, call 3
   0.1148  robot    hears of call 3: TaskAnswer
   0.1148  robot    performs task action 9
   0.1178  robot    hears of call 3: SensingAnswer
   0.1178  robot    hears of call 3: its end
   0.1250  robot    performs task actions 10 to 17
   0.2066  robot    performs sensing action 0 of step 18
   0.2076  robot    asks cloud-1, call 4
   0.2106  robot    hears of call 4: TaskAnswer
   0.2106  robot    performs task action 18
   0.2136  robot    hears of call 4: SensingAnswer
   0.2136  robot    hears of call 4: its end
   0.2208  robot    performs task actions 19 to 20
   0.2312  robot    is shown what was sensed in step 9
   0.2412  robot    asks cloud-1, call 5
   0.2442  robot    hears of call 5: TaskAnswer
   0.2442  robot    performs task action 21
   0.2472  robot    hears of call 5: SensingAnswer
   0.2472  robot    hears of call 5: its end
   0.2544  robot    performs task actions 22 to 26
   0.3054  robot    performs sensing action 0 of step 27
   0.3064  robot    asks cloud-1, call 6
   0.3094  robot    hears of call 6: TaskAnswer
   0.3094  robot    performs task action 27
   0.3124  robot    hears of call 6: SensingAnswer
   0.3124  robot    hears of call 6: its end
   0.3196  robot    performs task actions 28 to 35
   0.4012  robot    performs sensing action 2 of step 36
   0.4022  robot    unexplained trial=0 step=36 sensing_action=2 deviations=41.5642 reason=more than 8 standard deviations from every particle
   0.4022  robot    asks cloud-1, call 7
   0.4052  robot    hears of call 7: TaskAnswer
   0.4052  robot    performs task action 36
   0.4082  robot    hears of call 7: SensingAnswer
   0.4082  robot    hears of call 7: its end
   0.4154  robot    performs task actions 37 to 39
   0.4460  robot    ends trial 0 after 40 steps

decided as without faults
