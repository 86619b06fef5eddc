# Moves give observations, and the robot takes its task actions itself. It asks at each sensing step,
# with what all moves since the last one have shown, and waits there alone.
run what=sensing trial=2 moves_show=true
----
   0.0000  cloud-1  starts, process 1
   0.0010  robot    begins trial 2 at step 0
   0.0100  robot    service_appeared service=cloud-1
   0.0100  robot    asks cloud-1, call 1
   0.0150  robot    hears of call 1: SensingAnswer
   0.0150  robot    performs sensing action 0 of step 0
   0.0150  robot    hears of call 1: its end
   0.0160  robot    performs task actions 0 to 8
   0.1078  robot    asks cloud-1, call 2
   0.1128  robot    hears of call 2: SensingAnswer
   0.1128  robot    performs sensing action 0 of step 9
   0.1128  robot    hears of call 2: its end
   0.1138  robot    performs task actions 9 to 17
   0.2056  robot    asks cloud-1, call 3
   0.2106  robot    hears of call 3: SensingAnswer
   0.2106  robot    performs sensing action 0 of step 18
   0.2106  robot    hears of call 3: its end
   0.2116  robot    performs task actions 18 to 26
   0.3034  robot    asks cloud-1, call 4
   0.3084  robot    hears of call 4: SensingAnswer
   0.3084  robot    performs sensing action 0 of step 27
   0.3084  robot    hears of call 4: its end
   0.3094  robot    performs task actions 27 to 35
   0.4012  robot    asks cloud-1, call 5
   0.4062  robot    hears of call 5: SensingAnswer
   0.4062  robot    performs sensing action 2 of step 36
   0.4062  robot    hears of call 5: its end
   0.4072  robot    unexplained trial=2 step=36 sensing_action=2 deviations=31.9204 reason=more than 8 standard deviations from every particle
   0.4072  robot    performs task actions 36 to 39
   0.4480  robot    ends trial 2 after 40 steps

decided as without faults
