# The robot is carried away and senses that it is lost. It is killed before it has written down that
# its belief begins anew; its next process does it. An observation that was taken before comes late,
# and does not bring the old belief back.
run trial=2 on_lost=reinitialise
late step=0 moves=20
kill_robot boundary=25 before=journal down_s=0.05
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
   0.0292  robot    performs task actions 1 to 8
   0.1108  robot    performs sensing action 0 of step 9
   0.1118  robot    unexplained trial=2 step=9 sensing_action=0 deviations=86.3568 reason=more than 8 standard deviations from every particle
   0.1118  robot    lost trial=2 step=9 sensing_action=0 (x) outside=1 observations=1 false_alarm_rate=1 reason=the belief does not know where the robot is, or this sensor is dead: nothing else was sensed meanwhile
   0.1118  robot    is killed
   0.1618  robot    is started again
   0.1628  robot    begins trial 2 at step 9
   0.1628  robot    resumed_trial trial=2 step=9
   0.1628  robot    reinitialised trial=2 step=9
   0.1718  robot    service_appeared service=cloud-1
   0.1718  robot    restore service=cloud-1 step=9 bytes=1575
   0.1718  robot    asks cloud-1, call 1
   0.1748  robot    hears of call 1: TaskAnswer
   0.1748  robot    restored service=cloud-1 step=9 restore_ms=3
   0.1748  robot    performs task action 9
   0.1778  robot    hears of call 1: SensingAnswer
   0.1778  robot    hears of call 1: its end
   0.1850  robot    performs task actions 10 to 17
   0.2666  robot    performs sensing action 0 of step 18
   0.2676  robot    unexplained trial=2 step=18 sensing_action=0 deviations=59.1938 reason=more than 8 standard deviations from every particle
   0.2676  robot    asks cloud-1, call 2
   0.2706  robot    hears of call 2: TaskAnswer
   0.2706  robot    performs task action 18
   0.2736  robot    hears of call 2: SensingAnswer
   0.2736  robot    hears of call 2: its end
   0.2808  robot    performs task action 19
   0.2810  robot    is shown what was sensed in step 0
   0.2910  robot    asks cloud-1, call 3
   0.2940  robot    hears of call 3: TaskAnswer
   0.2940  robot    performs task action 20
   0.2940  robot    hears of call 3: SensingAnswer
   0.2940  robot    hears of call 3: its end
   0.3042  robot    performs task actions 21 to 26
   0.3654  robot    performs sensing action 0 of step 27
   0.3664  robot    unexplained trial=2 step=27 sensing_action=0 deviations=49.1611 reason=more than 8 standard deviations from every particle
   0.3664  robot    lost trial=2 step=27 sensing_action=0 (x) outside=1 observations=1 false_alarm_rate=1 reason=the belief does not know where the robot is, or this sensor is dead: nothing else was sensed meanwhile
   0.3664  robot    reinitialised trial=2 step=27
   0.3664  robot    asks cloud-1, call 4
   0.3694  robot    hears of call 4: TaskAnswer
   0.3694  robot    performs task action 27
   0.3724  robot    hears of call 4: SensingAnswer
   0.3724  robot    hears of call 4: its end
   0.3796  robot    performs task actions 28 to 35
   0.4612  robot    performs sensing action 0 of step 36
   0.4622  robot    asks cloud-1, call 5
   0.4652  robot    hears of call 5: TaskAnswer
   0.4652  robot    performs task action 36
   0.4682  robot    hears of call 5: SensingAnswer
   0.4682  robot    hears of call 5: its end
   0.4754  robot    performs task actions 37 to 39
   0.5060  robot    ends trial 2 after 40 steps

decided as without faults
