# An observation comes with the last move before a sensing step. The sensing action for that step
# was computed already, in a state that is not the robot's any more.
run
late step=0 moves=9
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
   0.1008  robot    is shown what was sensed in step 0
   0.1108  robot    asks cloud-1, call 3
   0.1158  robot    hears of call 3: SensingAnswer
   0.1158  robot    performs sensing action 0 of step 9
   0.1158  robot    hears of call 3: its end
   0.1168  robot    asks cloud-1, call 4
   0.1198  robot    hears of call 4: TaskAnswer
   0.1198  robot    performs task action 9
   0.1228  robot    hears of call 4: SensingAnswer
   0.1228  robot    hears of call 4: its end
   0.1300  robot    performs task actions 10 to 17
   0.2116  robot    performs sensing action 0 of step 18
   0.2126  robot    asks cloud-1, call 5
   0.2156  robot    hears of call 5: TaskAnswer
   0.2156  robot    performs task action 18
   0.2186  robot    hears of call 5: SensingAnswer
   0.2186  robot    hears of call 5: its end
   0.2258  robot    performs task actions 19 to 26
   0.3074  robot    performs sensing action 0 of step 27
   0.3084  robot    asks cloud-1, call 6
   0.3114  robot    hears of call 6: TaskAnswer
   0.3114  robot    performs task action 27
   0.3144  robot    hears of call 6: SensingAnswer
   0.3144  robot    hears of call 6: its end
   0.3216  robot    performs task actions 28 to 35
   0.4032  robot    performs sensing action 2 of step 36
   0.4042  robot    unexplained trial=0 step=36 sensing_action=2 deviations=41.5642 reason=more than 8 standard deviations from every particle
   0.4042  robot    asks cloud-1, call 7
   0.4072  robot    hears of call 7: TaskAnswer
   0.4072  robot    performs task action 36
   0.4102  robot    hears of call 7: SensingAnswer
   0.4102  robot    hears of call 7: its end
   0.4174  robot    performs task actions 37 to 39
   0.4480  robot    ends trial 0 after 40 steps

decided as without faults
