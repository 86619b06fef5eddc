# The cloud is stopped, then the local service, and only the cloud goes on. The robot, which waits for
# the silent local service, asks the cloud again.
run
stop node=cloud-1 at=0.1 for_s=0.6
stop node=local at=0.6 for_s=30
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
   0.1000  cloud-1  is stopped
   0.1006  robot    performs task action 8
   0.1108  robot    performs sensing action 0 of step 9
   0.1118  robot    asks cloud-1, call 3
   0.3618  robot    service_suspected service=cloud-1 reason=no sign of progress for 250 ms
   0.3618  robot    status from=standard to=local_recovery silent_ms=250 reason=cloud-1 no sign of progress for 250 ms
   0.3618  robot    launch service=local
   0.3618  local    is launched
   0.3618  robot    retry service=cloud-1 step=9 attempt=2 waited_ms=250
   0.3618  robot    asks cloud-1, call 4
   0.3618  robot    holding step=9 reason=cloud-1: no sign of progress for 250 ms; local: is being launched
   0.5000  robot    service_vanished service=cloud-1
   0.5000  robot    hears of call 3: its end
   0.5000  robot    hears of call 4: its end
   0.5118  local    starts, process 1
   0.5218  robot    launched launch_ms=160
   0.5218  robot    restore service=local step=9 bytes=1575
   0.5218  robot    retry service=local step=9 attempt=3 waited_ms=410
   0.5218  robot    asks local, call 5
   0.5230  robot    hears of call 5: TaskAnswer
   0.5230  robot    restored service=local step=9 restore_ms=1.2
   0.5230  robot    resumed held_ms=161.2
   0.5230  robot    performs task action 9
   0.5260  robot    hears of call 5: SensingAnswer
   0.5260  robot    hears of call 5: its end
   0.5332  robot    performs task actions 10 to 16
   0.6000  local    is stopped
   0.6046  robot    performs task action 17
   0.6148  robot    performs sensing action 0 of step 18
   0.6158  robot    asks local, call 6
   0.7000  cloud-1  goes on
   0.7100  robot    service_appeared service=cloud-1
   0.7100  robot    asks cloud-1, call 7
   0.7130  robot    hears of call 7: TaskAnswer
   0.7130  robot    status from=local_recovery to=keep_alive outage_ms=351.2 reason=cloud-1 has answered
   0.7130  robot    performs task action 18
   0.7160  robot    hears of call 7: SensingAnswer
   0.7160  robot    hears of call 7: its end
   0.7232  robot    performs task actions 19 to 26
   0.8048  robot    performs sensing action 0 of step 27
   0.8058  robot    asks cloud-1, call 8
   0.8088  robot    hears of call 8: TaskAnswer
   0.8088  robot    performs task action 27
   0.8118  robot    hears of call 8: SensingAnswer
   0.8118  robot    hears of call 8: its end
   0.8190  robot    performs task actions 28 to 35
   0.9006  robot    performs sensing action 2 of step 36
   0.9016  robot    unexplained trial=0 step=36 sensing_action=2 deviations=41.5642 reason=more than 8 standard deviations from every particle
   0.9016  robot    asks cloud-1, call 9
   0.9046  robot    hears of call 9: TaskAnswer
   0.9046  robot    performs task action 36
   0.9076  robot    hears of call 9: SensingAnswer
   0.9076  robot    hears of call 9: its end
   0.9148  robot    performs task actions 37 to 39
   0.9454  robot    ends trial 0 after 40 steps
  30.6000  local    goes on

decided as without faults
