# The local service fails at its first launch and is late at the second.
run
crash service=cloud-1 at=0.05 down_s=3600
launch number=1 what=fails seconds=0.02
launch number=2 what=late seconds=0.3
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
   0.0292  robot    performs task actions 1 to 3
   0.0500  cloud-1  is killed
   0.0520  robot    service_vanished service=cloud-1
   0.0520  robot    status from=standard to=local_recovery silent_ms=30 reason=cloud-1 is gone
   0.0520  robot    launch service=local
   0.0520  local    is launched
   0.0598  robot    performs task actions 4 to 5
   0.0720  robot    recovery_exited reason=ended with exit code 1
   0.0720  robot    launch service=local
   0.0720  local    is launched
   0.0802  robot    performs task actions 6 to 8
   0.1108  robot    performs sensing action 0 of step 9
   0.1118  robot    holding step=9 reason=cloud-1: is not there; local: is being launched
   0.5220  local    starts, process 1
   0.5320  robot    launched launch_ms=460
   0.5320  robot    restore service=local step=9 bytes=1575
   0.5320  robot    asks local, call 3
   0.5332  robot    hears of call 3: TaskAnswer
   0.5332  robot    restored service=local step=9 restore_ms=1.2
   0.5332  robot    resumed held_ms=421.4
   0.5332  robot    performs task action 9
   0.5362  robot    hears of call 3: SensingAnswer
   0.5362  robot    hears of call 3: its end
   0.5434  robot    performs task actions 10 to 17
   0.6250  robot    performs sensing action 0 of step 18
   0.6260  robot    asks local, call 4
   0.6272  robot    hears of call 4: TaskAnswer
   0.6272  robot    performs task action 18
   0.6302  robot    hears of call 4: SensingAnswer
   0.6302  robot    hears of call 4: its end
   0.6374  robot    performs task actions 19 to 26
   0.7190  robot    performs sensing action 0 of step 27
   0.7200  robot    asks local, call 5
   0.7212  robot    hears of call 5: TaskAnswer
   0.7212  robot    performs task action 27
   0.7242  robot    hears of call 5: SensingAnswer
   0.7242  robot    hears of call 5: its end
   0.7314  robot    performs task actions 28 to 35
   0.8130  robot    performs sensing action 2 of step 36
   0.8140  robot    unexplained trial=0 step=36 sensing_action=2 deviations=41.5642 reason=more than 8 standard deviations from every particle
   0.8140  robot    asks local, call 6
   0.8152  robot    hears of call 6: TaskAnswer
   0.8152  robot    performs task action 36
   0.8182  robot    hears of call 6: SensingAnswer
   0.8182  robot    hears of call 6: its end
   0.8254  robot    performs task actions 37 to 39
   0.8560  robot    ends trial 0 after 40 steps

decided as without faults
