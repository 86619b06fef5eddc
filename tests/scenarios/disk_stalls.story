# Writes to the journal take longer than a service may be silent, and the robot hears nothing
# meanwhile. No service is blamed for that time.
run
disk_stall at=0.111 for_s=0.3
disk_stall at=0.5 for_s=0.6
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
   0.1118  robot    writes to its journal for 0.3 s
   0.1148  robot    hears of call 3: TaskAnswer
   0.1178  robot    hears of call 3: SensingAnswer
   0.1178  robot    hears of call 3: its end
   0.4118  robot    performs task actions 9 to 17
   0.5036  robot    writes to its journal for 0.6 s
   1.1036  robot    performs sensing action 0 of step 18
   1.1046  robot    asks cloud-1, call 4
   1.1076  robot    hears of call 4: TaskAnswer
   1.1076  robot    performs task action 18
   1.1106  robot    hears of call 4: SensingAnswer
   1.1106  robot    hears of call 4: its end
   1.1178  robot    performs task actions 19 to 26
   1.1994  robot    performs sensing action 0 of step 27
   1.2004  robot    asks cloud-1, call 5
   1.2034  robot    hears of call 5: TaskAnswer
   1.2034  robot    performs task action 27
   1.2064  robot    hears of call 5: SensingAnswer
   1.2064  robot    hears of call 5: its end
   1.2136  robot    performs task actions 28 to 35
   1.2952  robot    performs sensing action 2 of step 36
   1.2962  robot    unexplained trial=0 step=36 sensing_action=2 deviations=41.5642 reason=more than 8 standard deviations from every particle
   1.2962  robot    asks cloud-1, call 6
   1.2992  robot    hears of call 6: TaskAnswer
   1.2992  robot    performs task action 36
   1.3022  robot    hears of call 6: SensingAnswer
   1.3022  robot    hears of call 6: its end
   1.3094  robot    performs task actions 37 to 39
   1.3400  robot    ends trial 0 after 40 steps

decided as without faults
