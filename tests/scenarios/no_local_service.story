# The cloud dies and comes back, and the robot may launch nothing: it holds still, says why, and goes
# on as soon as the cloud is back.
run launch=never
crash service=cloud-1 at=0.1 down_s=3
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
   0.0292  robot    performs task actions 1 to 7
   0.1000  cloud-1  is killed
   0.1006  robot    performs task action 8
   0.1020  robot    service_vanished service=cloud-1
   0.1108  robot    performs sensing action 0 of step 9
   0.1118  robot    holding step=9 reason=cloud-1: is not there
   3.1000  cloud-1  starts, process 2
   3.1100  robot    service_appeared service=cloud-1
   3.1100  robot    restore service=cloud-1 step=9 bytes=1575
   3.1100  robot    asks cloud-1, call 3
   3.1130  robot    hears of call 3: TaskAnswer
   3.1130  robot    restored service=cloud-1 step=9 restore_ms=3
   3.1130  robot    resumed held_ms=3001.2
   3.1130  robot    waiting service=cloud-1 step=9 waited_ms=3001.2
   3.1130  robot    performs task action 9
   3.1160  robot    hears of call 3: SensingAnswer
   3.1160  robot    hears of call 3: its end
   3.1232  robot    performs task actions 10 to 17
   3.2048  robot    performs sensing action 0 of step 18
   3.2058  robot    asks cloud-1, call 4
   3.2088  robot    hears of call 4: TaskAnswer
   3.2088  robot    performs task action 18
   3.2118  robot    hears of call 4: SensingAnswer
   3.2118  robot    hears of call 4: its end
   3.2190  robot    performs task actions 19 to 26
   3.3006  robot    performs sensing action 0 of step 27
   3.3016  robot    asks cloud-1, call 5
   3.3046  robot    hears of call 5: TaskAnswer
   3.3046  robot    performs task action 27
   3.3076  robot    hears of call 5: SensingAnswer
   3.3076  robot    hears of call 5: its end
   3.3148  robot    performs task actions 28 to 35
   3.3964  robot    performs sensing action 2 of step 36
   3.3974  robot    unexplained trial=0 step=36 sensing_action=2 deviations=41.5642 reason=more than 8 standard deviations from every particle
   3.3974  robot    asks cloud-1, call 6
   3.4004  robot    hears of call 6: TaskAnswer
   3.4004  robot    performs task action 36
   3.4034  robot    hears of call 6: SensingAnswer
   3.4034  robot    hears of call 6: its end
   3.4106  robot    performs task actions 37 to 39
   3.4412  robot    ends trial 0 after 40 steps

decided as without faults
