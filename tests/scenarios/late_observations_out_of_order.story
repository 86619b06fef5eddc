# The second of three is there first, then the third; the first comes last and the fourth never. One
# comes twice, and counts once.
run
late step=0 moves=30
late step=9 moves=2
late step=9 moves=4
late step=18 moves=5
late step=27 moves=none
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
   0.1250  robot    performs task action 10
   0.1252  robot    is shown what was sensed in step 9
   0.1352  robot    asks cloud-1, call 4
   0.1382  robot    hears of call 4: TaskAnswer
   0.1382  robot    performs task action 11
   0.1412  robot    hears of call 4: SensingAnswer
   0.1412  robot    hears of call 4: its end
   0.1484  robot    performs task action 12
   0.1486  robot    is shown what was sensed in step 9
   0.1586  robot    late_unused trial=0 step=13 taken=9 reason=no observation of that step is awaited: it has come before, was given up, or nothing was sensed there
   0.1586  robot    performs task actions 13 to 17
   0.2096  robot    performs sensing action 0 of step 18
   0.2106  robot    asks cloud-1, call 5
   0.2136  robot    hears of call 5: TaskAnswer
   0.2136  robot    performs task action 18
   0.2166  robot    hears of call 5: SensingAnswer
   0.2166  robot    hears of call 5: its end
   0.2238  robot    performs task actions 19 to 22
   0.2546  robot    is shown what was sensed in step 18
   0.2646  robot    asks cloud-1, call 6
   0.2676  robot    hears of call 6: TaskAnswer
   0.2676  robot    performs task action 23
   0.2706  robot    hears of call 6: SensingAnswer
   0.2706  robot    hears of call 6: its end
   0.2778  robot    performs task actions 24 to 26
   0.3084  robot    performs sensing action 0 of step 27
   0.3094  robot    no_reading trial=0 step=27 sensing_action=0 reason=the belief stays as it is
   0.3094  robot    asks cloud-1, call 7
   0.3124  robot    hears of call 7: TaskAnswer
   0.3124  robot    performs task action 27
   0.3154  robot    hears of call 7: SensingAnswer
   0.3154  robot    hears of call 7: its end
   0.3226  robot    performs task actions 28 to 29
   0.3330  robot    is shown what was sensed in step 0
   0.3430  robot    asks cloud-1, call 8
   0.3460  robot    hears of call 8: TaskAnswer
   0.3460  robot    performs task action 30
   0.3490  robot    hears of call 8: SensingAnswer
   0.3490  robot    hears of call 8: its end
   0.3562  robot    performs task actions 31 to 35
   0.4072  robot    performs sensing action 0 of step 36
   0.4082  robot    asks cloud-1, call 9
   0.4112  robot    hears of call 9: TaskAnswer
   0.4112  robot    performs task action 36
   0.4142  robot    hears of call 9: SensingAnswer
   0.4142  robot    hears of call 9: its end
   0.4214  robot    performs task actions 37 to 39
   0.4520  robot    ends trial 0 after 40 steps

decided as without faults
