# The ends of calls are lost, so calls that were answered stay open in the transport.
run launch_s=0.6
message service=cloud-1 direction=to number=8 what=drop
message service=cloud-1 direction=to number=11 what=drop
message service=cloud-1 direction=from number=0 what=drop
message service=cloud-1 direction=from number=1 what=drop
message service=cloud-1 direction=from number=2 what=drop
message service=cloud-1 direction=from number=5 what=drop
message service=cloud-1 direction=from number=7 what=drop
message service=cloud-1 direction=from number=14 what=drop
message service=cloud-1 direction=from number=15 what=drop
message service=cloud-1 direction=from number=20 what=drop
message service=cloud-1 direction=from number=21 what=drop
message service=cloud-1 direction=from number=26 what=drop
message service=local direction=to number=0 what=drop
----
   0.0000  cloud-1  starts, process 1
   0.0010  robot    begins trial 0 at step 0
   0.0100  robot    service_appeared service=cloud-1
   0.0100  robot    asks cloud-1, call 1
   0.2600  robot    service_suspected service=cloud-1 reason=no sign of progress for 250 ms
   0.2600  robot    status from=standard to=local_recovery silent_ms=250 reason=cloud-1 no sign of progress for 250 ms
   0.2600  robot    launch service=local
   0.2600  local    is launched
   0.2600  robot    retry service=cloud-1 step=0 attempt=2 waited_ms=259
   0.2600  robot    asks cloud-1, call 2
   0.2600  robot    holding step=0 reason=cloud-1: no sign of progress for 250 ms; local: is being launched
   0.2620  robot    hears of call 2: its end
   0.3020  robot    retry service=cloud-1 step=0 attempt=3 waited_ms=301
   0.3020  robot    asks cloud-1, call 3
   0.3040  robot    hears of call 3: SensingAnswer
   0.3040  robot    resumed held_ms=44
   0.3040  robot    status from=local_recovery to=keep_alive outage_ms=44 reason=cloud-1 has answered
   0.3040  robot    performs sensing action 0 of step 0
   0.3050  robot    asks cloud-1, call 4
   0.3080  robot    hears of call 4: TaskAnswer
   0.3080  robot    performs task action 0
   0.3110  robot    hears of call 4: its end
   0.3110  robot    service_suspected service=cloud-1 reason=a call ended without the answer
   0.3110  robot    status from=keep_alive to=local_recovery silent_ms=3 reason=cloud-1 a call ended without the answer
   0.3182  robot    performs task actions 1 to 2
   0.3310  robot    retry service=cloud-1 step=0 attempt=2 waited_ms=0
   0.3310  robot    asks cloud-1, call 5
   0.3330  robot    hears of call 5: TaskAnswer
   0.3330  robot    status from=local_recovery to=keep_alive outage_ms=22 reason=cloud-1 has answered
   0.3330  robot    hears of call 5: SensingAnswer
   0.3330  robot    hears of call 5: its end
   0.3386  robot    performs task actions 3 to 8
   0.3998  robot    performs sensing action 0 of step 9
   0.4008  robot    asks cloud-1, call 6
   0.4038  robot    hears of call 6: TaskAnswer
   0.4038  robot    performs task action 9
   0.4068  robot    hears of call 6: SensingAnswer
   0.4140  robot    performs task actions 10 to 17
   0.4956  robot    performs sensing action 0 of step 18
   0.4966  robot    asks cloud-1, call 7
   0.5026  robot    hears of call 7: SensingAnswer
   0.5026  robot    hears of call 7: its end
   0.5026  robot    service_suspected service=cloud-1 reason=a call ended without the answer
   0.5026  robot    status from=keep_alive to=local_recovery silent_ms=0 reason=cloud-1 a call ended without the answer
   0.5026  robot    holding step=18 reason=cloud-1: a call ended without the answer; local: is being launched
   0.5226  robot    retry service=cloud-1 step=18 attempt=2 waited_ms=26
   0.5226  robot    asks cloud-1, call 8
   0.5246  robot    hears of call 8: TaskAnswer
   0.5246  robot    resumed held_ms=22
   0.5246  robot    status from=local_recovery to=keep_alive outage_ms=22 reason=cloud-1 has answered
   0.5246  robot    performs task action 18
   0.5246  robot    hears of call 8: SensingAnswer
   0.5348  robot    performs task actions 19 to 26
   0.6164  robot    performs sensing action 0 of step 27
   0.6174  robot    asks cloud-1, call 9
   0.8600  local    starts, process 1
   0.8674  robot    service_suspected service=cloud-1 reason=no sign of progress for 250 ms
   0.8674  robot    status from=keep_alive to=local_recovery silent_ms=250 reason=cloud-1 no sign of progress for 250 ms
   0.8674  robot    retry service=cloud-1 step=27 attempt=2 waited_ms=250
   0.8674  robot    asks cloud-1, call 10
   0.8674  robot    holding step=27 reason=cloud-1: no sign of progress for 250 ms; local: is being launched
   0.8700  robot    launched launch_ms=610
   0.8700  robot    restore service=local step=27 bytes=1575
   0.8700  robot    retry service=local step=27 attempt=3 waited_ms=252.6
   0.8700  robot    asks local, call 11
   0.8734  robot    hears of call 10: SensingAnswer
   0.8734  robot    resumed held_ms=6
   0.8734  robot    status from=local_recovery to=keep_alive outage_ms=6 reason=cloud-1 has answered
   0.8734  robot    hears of call 10: its end
   0.8734  robot    service_suspected service=cloud-1 reason=a call ended without the answer
   0.8734  robot    status from=keep_alive to=local_recovery silent_ms=0 reason=cloud-1 a call ended without the answer
   0.8934  robot    asks cloud-1, call 12
   0.8954  robot    hears of call 12: TaskAnswer
   0.8954  robot    status from=local_recovery to=keep_alive outage_ms=22 reason=cloud-1 has answered
   0.8954  robot    performs task action 27
   0.8954  robot    hears of call 12: SensingAnswer
   0.9056  robot    performs task actions 28 to 35
   0.9872  robot    performs sensing action 2 of step 36
   0.9882  robot    unexplained trial=0 step=36 sensing_action=2 deviations=41.5642 reason=more than 8 standard deviations from every particle
   0.9882  robot    asks cloud-1, call 13
   1.2382  robot    service_suspected service=cloud-1 reason=no sign of progress for 250 ms
   1.2382  robot    status from=keep_alive to=local_recovery silent_ms=250 reason=cloud-1 no sign of progress for 250 ms
   1.2382  robot    restore service=local step=36 bytes=1575
   1.2382  robot    retry service=local step=36 attempt=2 waited_ms=250
   1.2382  robot    asks local, call 14
   1.2394  robot    hears of call 14: TaskAnswer
   1.2394  robot    restored service=local step=36 restore_ms=1.2
   1.2394  robot    asks cloud-1, call 15
   1.2394  robot    performs task action 36
   1.2424  robot    hears of call 15: TaskAnswer
   1.2424  robot    status from=local_recovery to=keep_alive outage_ms=4.2 reason=cloud-1 has answered
   1.2424  robot    hears of call 14: SensingAnswer
   1.2424  robot    hears of call 14: its end
   1.2454  robot    hears of call 15: SensingAnswer
   1.2454  robot    hears of call 15: its end
   1.2496  robot    performs task actions 37 to 39
   1.2802  robot    ends trial 0 after 40 steps

decided as without faults
