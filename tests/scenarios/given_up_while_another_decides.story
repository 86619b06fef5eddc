# The first of two services is stopped for a moment, so the second decides. The first one, which is
# up again, is asked the next question too, one at a time, and decides alone once it has answered.
run replicas=2
stop node=cloud-1 at=0.1 for_s=0.3
----
   0.0000  cloud-1  starts, process 1
   0.0000  cloud-2  starts, process 1
   0.0010  robot    begins trial 0 at step 0
   0.0100  robot    service_appeared service=cloud-1
   0.0100  robot    asks cloud-1, call 1
   0.0100  robot    service_appeared service=cloud-2
   0.0150  robot    hears of call 1: SensingAnswer
   0.0150  robot    performs sensing action 0 of step 0
   0.0150  robot    hears of call 1: its end
   0.0160  robot    asks cloud-1, call 2
   0.0190  robot    hears of call 2: TaskAnswer
   0.0190  robot    performs task action 0
   0.0220  robot    hears of call 2: SensingAnswer
   0.0220  robot    hears of call 2: its end
   0.0292  robot    performs task actions 1 to 7
   0.1000  cloud-1  is stopped
   0.1006  robot    performs task action 8
   0.1108  robot    performs sensing action 0 of step 9
   0.1118  robot    asks cloud-1, call 3
   0.3618  robot    service_suspected service=cloud-1 reason=no sign of progress for 250 ms
   0.3618  robot    restore service=cloud-2 step=9 bytes=1575
   0.3618  robot    retry service=cloud-2 step=9 attempt=2 waited_ms=250
   0.3618  robot    asks cloud-2, call 4
   0.3648  robot    hears of call 4: TaskAnswer
   0.3648  robot    restored service=cloud-2 step=9 restore_ms=3
   0.3648  robot    asks cloud-1, call 5
   0.3648  robot    performs task action 9
   0.3678  robot    hears of call 4: SensingAnswer
   0.3678  robot    hears of call 4: its end
   0.3750  robot    performs task actions 10 to 12
   0.4000  cloud-1  goes on
   0.4020  robot    hears of call 3: TaskAnswer
   0.4020  robot    hears of call 5: TaskAnswer
   0.4050  robot    hears of call 5: SensingAnswer
   0.4050  robot    hears of call 5: its end
   0.4056  robot    performs task actions 13 to 17
   0.4566  robot    performs sensing action 0 of step 18
   0.4576  robot    asks cloud-1, call 6
   0.4606  robot    hears of call 6: TaskAnswer
   0.4606  robot    performs task action 18
   0.4636  robot    hears of call 6: SensingAnswer
   0.4636  robot    hears of call 6: its end
   0.4708  robot    performs task actions 19 to 26
   0.5524  robot    performs sensing action 0 of step 27
   0.5534  robot    asks cloud-1, call 7
   0.5564  robot    hears of call 7: TaskAnswer
   0.5564  robot    performs task action 27
   0.5594  robot    hears of call 7: SensingAnswer
   0.5594  robot    hears of call 7: its end
   0.5666  robot    performs task actions 28 to 35
   0.6482  robot    performs sensing action 2 of step 36
   0.6492  robot    unexplained trial=0 step=36 sensing_action=2 deviations=41.5642 reason=more than 8 standard deviations from every particle
   0.6492  robot    asks cloud-1, call 8
   0.6522  robot    hears of call 8: TaskAnswer
   0.6522  robot    performs task action 36
   0.6552  robot    hears of call 8: SensingAnswer
   0.6552  robot    hears of call 8: its end
   0.6624  robot    performs task actions 37 to 39
   0.6930  robot    ends trial 0 after 40 steps

decided as without faults
