# The cloud dies and comes back very slow, saying that it is at work. The local service, which is there
# by then, decides; once the robot waited for the cloud alone, and sent it its state again and again.
run trial=3
crash service=cloud-1 at=0.1 down_s=0.05
slow service=cloud-1 at=0.16 for_s=1 factor=2000
----
   0.0000  cloud-1  starts, process 1
   0.0010  robot    begins trial 3 at step 0
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
   0.1020  robot    status from=standard to=local_recovery silent_ms=80 reason=cloud-1 is gone
   0.1020  robot    launch service=local
   0.1020  local    is launched
   0.1108  robot    performs sensing action 0 of step 9
   0.1118  robot    holding step=9 reason=cloud-1: is not there; local: is being launched
   0.1500  cloud-1  starts, process 2
   0.1600  cloud-1  computes 2000 times as long
   0.1600  robot    service_appeared service=cloud-1
   0.1600  robot    restore service=cloud-1 step=9 bytes=1575
   0.1600  robot    asks cloud-1, call 3
   0.2120  robot    hears of call 3: Progress
   0.2120  robot    resumed held_ms=100.2
   0.2520  local    starts, process 1
   0.2620  robot    launched launch_ms=160
   0.2620  robot    restore service=local step=9 bytes=1575
   0.2620  robot    retry service=local step=9 attempt=2 waited_ms=150.2
   0.2620  robot    asks local, call 4
   0.2620  robot    hears of call 3: Progress
   0.2632  robot    hears of call 4: TaskAnswer
   0.2632  robot    restored service=local step=9 restore_ms=1.2
   0.2632  robot    performs task action 9
   0.2662  robot    hears of call 4: SensingAnswer
   0.2662  robot    hears of call 4: its end
   0.2734  robot    performs task actions 10 to 13
   0.3120  robot    hears of call 3: Progress
   0.3142  robot    performs task actions 14 to 17
   0.3550  robot    performs sensing action 0 of step 18
   0.3560  robot    asks local, call 5
   0.3572  robot    hears of call 5: TaskAnswer
   0.3572  robot    performs task action 18
   0.3602  robot    hears of call 5: SensingAnswer
   0.3602  robot    hears of call 5: its end
   0.3620  robot    hears of call 3: Progress
   0.3674  robot    performs task actions 19 to 23
   0.4120  robot    hears of call 3: Progress
   0.4184  robot    performs task actions 24 to 26
   0.4490  robot    performs sensing action 0 of step 27
   0.4500  robot    asks local, call 6
   0.4500  robot    restore service=cloud-1 step=27 bytes=1575
   0.4500  robot    asks cloud-1, call 7
   0.4512  robot    hears of call 6: TaskAnswer
   0.4512  robot    performs task action 27
   0.4520  robot    hears of call 3: its end
   0.4542  robot    hears of call 6: SensingAnswer
   0.4542  robot    hears of call 6: its end
   0.4614  robot    performs task actions 28 to 31
   0.5020  robot    hears of call 7: Progress
   0.5022  robot    performs task actions 32 to 35
   0.5430  robot    performs sensing action 0 of step 36
   0.5440  robot    asks local, call 8
   0.5452  robot    hears of call 8: TaskAnswer
   0.5452  robot    performs task action 36
   0.5482  robot    hears of call 8: SensingAnswer
   0.5482  robot    hears of call 8: its end
   0.5520  robot    hears of call 7: Progress
   0.5554  robot    performs task actions 37 to 39
   0.5860  robot    ends trial 3 after 40 steps

decided as without faults
