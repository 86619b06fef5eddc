# An observation that no particle explains: the robot is lost, and is killed before it has written
# down that its belief begins anew. Its next process does it. An observation that was taken before
# comes late, and does not bring the old belief back.
run on_lost=reinitialise
late step=18 moves=20
kill_robot boundary=91 before=journal down_s=0.05
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
   0.2208  robot    performs task actions 19 to 26
   0.3024  robot    performs sensing action 0 of step 27
   0.3034  robot    asks cloud-1, call 5
   0.3064  robot    hears of call 5: TaskAnswer
   0.3064  robot    performs task action 27
   0.3094  robot    hears of call 5: SensingAnswer
   0.3094  robot    hears of call 5: its end
   0.3166  robot    performs task actions 28 to 35
   0.3982  robot    performs sensing action 2 of step 36
   0.3992  robot    unexplained trial=0 step=36 sensing_action=2 deviations=19.7811 reason=more than 8 standard deviations from every particle
   0.3992  robot    lost trial=0 step=36 sensing_action=2 (θ) outside=1 observations=1 false_alarm_rate=1 reason=the belief does not know where the robot is, or this sensor is dead: nothing else was sensed meanwhile
   0.3992  robot    is killed
   0.4492  robot    is started again
   0.4502  robot    begins trial 0 at step 36
   0.4502  robot    resumed_trial trial=0 step=36
   0.4502  robot    reinitialised trial=0 step=36
   0.4592  robot    service_appeared service=cloud-1
   0.4592  robot    restore service=cloud-1 step=36 bytes=1567
   0.4592  robot    asks cloud-1, call 1
   0.4622  robot    hears of call 1: TaskAnswer
   0.4622  robot    restored service=cloud-1 step=36 restore_ms=3
   0.4622  robot    performs task action 36
   0.4652  robot    hears of call 1: SensingAnswer
   0.4652  robot    hears of call 1: its end
   0.4724  robot    performs task action 37
   0.4726  robot    is shown what was sensed in step 18
   0.4826  robot    asks cloud-1, call 2
   0.4856  robot    hears of call 2: TaskAnswer
   0.4856  robot    performs task action 38
   0.4856  robot    hears of call 2: SensingAnswer
   0.4856  robot    hears of call 2: its end
   0.4958  robot    performs task action 39
   0.5060  robot    ends trial 0 after 40 steps

decided as without faults
