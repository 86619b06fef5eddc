# An observation comes late, between two task actions that the robot takes itself. The next one comes
# from the new belief, and what to sense is asked anew.
run what=sensing trial=2
late step=9 moves=3
----
   0.0000  cloud-1  starts, process 1
   0.0010  robot    begins trial 2 at step 0
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
   0.0262  robot    performs task actions 1 to 8
   0.1078  robot    performs sensing action 0 of step 9
   0.1088  robot    asks cloud-1, call 3
   0.1088  robot    performs task action 9
   0.1118  robot    hears of call 3: TaskAnswer
   0.1148  robot    hears of call 3: SensingAnswer
   0.1148  robot    hears of call 3: its end
   0.1190  robot    performs task actions 10 to 11
   0.1294  robot    is shown what was sensed in step 9
   0.1394  robot    asks cloud-1, call 4
   0.1394  robot    performs task action 12
   0.1424  robot    hears of call 4: TaskAnswer
   0.1454  robot    hears of call 4: SensingAnswer
   0.1454  robot    hears of call 4: its end
   0.1496  robot    performs task actions 13 to 17
   0.2006  robot    performs sensing action 0 of step 18
   0.2016  robot    asks cloud-1, call 5
   0.2016  robot    performs task action 18
   0.2046  robot    hears of call 5: TaskAnswer
   0.2076  robot    hears of call 5: SensingAnswer
   0.2076  robot    hears of call 5: its end
   0.2118  robot    performs task actions 19 to 26
   0.2934  robot    performs sensing action 0 of step 27
   0.2944  robot    asks cloud-1, call 6
   0.2944  robot    performs task action 27
   0.2974  robot    hears of call 6: TaskAnswer
   0.3004  robot    hears of call 6: SensingAnswer
   0.3004  robot    hears of call 6: its end
   0.3046  robot    performs task actions 28 to 35
   0.3862  robot    performs sensing action 2 of step 36
   0.3872  robot    asks cloud-1, call 7
   0.3872  robot    performs task action 36
   0.3902  robot    hears of call 7: TaskAnswer
   0.3932  robot    hears of call 7: SensingAnswer
   0.3932  robot    hears of call 7: its end
   0.3974  robot    performs task actions 37 to 39
   0.4280  robot    ends trial 2 after 40 steps

decided as without faults
