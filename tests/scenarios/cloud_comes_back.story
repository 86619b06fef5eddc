# The cloud dies and comes back: standard, local recovery, keep alive. The new process is handed the
# state once.
run
crash service=cloud-1 at=0.1 down_s=0.3
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
   0.1020  robot    status from=standard to=local_recovery silent_ms=80 reason=cloud-1 is gone
   0.1020  robot    launch service=local
   0.1020  local    is launched
   0.1108  robot    performs sensing action 0 of step 9
   0.1118  robot    holding step=9 reason=cloud-1: is not there; local: is being launched
   0.2520  local    starts, process 1
   0.2620  robot    launched launch_ms=160
   0.2620  robot    restore service=local step=9 bytes=1575
   0.2620  robot    asks local, call 3
   0.2632  robot    hears of call 3: TaskAnswer
   0.2632  robot    restored service=local step=9 restore_ms=1.2
   0.2632  robot    resumed held_ms=151.4
   0.2632  robot    performs task action 9
   0.2662  robot    hears of call 3: SensingAnswer
   0.2662  robot    hears of call 3: its end
   0.2734  robot    performs task actions 10 to 17
   0.3550  robot    performs sensing action 0 of step 18
   0.3560  robot    asks local, call 4
   0.3572  robot    hears of call 4: TaskAnswer
   0.3572  robot    performs task action 18
   0.3602  robot    hears of call 4: SensingAnswer
   0.3602  robot    hears of call 4: its end
   0.3674  robot    performs task actions 19 to 22
   0.4000  cloud-1  starts, process 2
   0.4082  robot    performs task action 23
   0.4100  robot    service_appeared service=cloud-1
   0.4100  robot    restore service=cloud-1 step=18 bytes=1575
   0.4100  robot    asks cloud-1, call 5
   0.4130  robot    hears of call 5: TaskAnswer
   0.4130  robot    restored service=cloud-1 step=18 restore_ms=3
   0.4130  robot    status from=local_recovery to=keep_alive outage_ms=311 reason=cloud-1 has answered
   0.4160  robot    hears of call 5: SensingAnswer
   0.4160  robot    hears of call 5: its end
   0.4184  robot    performs task actions 24 to 26
   0.4490  robot    performs sensing action 0 of step 27
   0.4500  robot    asks cloud-1, call 6
   0.4530  robot    hears of call 6: TaskAnswer
   0.4530  robot    performs task action 27
   0.4560  robot    hears of call 6: SensingAnswer
   0.4560  robot    hears of call 6: its end
   0.4632  robot    performs task actions 28 to 35
   0.5448  robot    performs sensing action 2 of step 36
   0.5458  robot    unexplained trial=0 step=36 sensing_action=2 deviations=41.5642 reason=more than 8 standard deviations from every particle
   0.5458  robot    asks cloud-1, call 7
   0.5488  robot    hears of call 7: TaskAnswer
   0.5488  robot    performs task action 36
   0.5518  robot    hears of call 7: SensingAnswer
   0.5518  robot    hears of call 7: its end
   0.5590  robot    performs task actions 37 to 39
   0.5896  robot    ends trial 0 after 40 steps

decided as without faults
