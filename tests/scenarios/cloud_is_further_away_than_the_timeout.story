# The way to the cloud and back takes 400 ms, the robot gives a service up after 250. So each turn changes
# hands, and what the cloud answers comes too late. After three such answers the log says what to do.
run trial=3 latency_s=0.2 lease_s=3.0
----
   0.0000  cloud-1  starts, process 1
   0.0010  robot    begins trial 3 at step 0
   0.0100  robot    service_appeared service=cloud-1
   0.0100  robot    asks cloud-1, call 1
   0.2600  robot    service_suspected service=cloud-1 reason=no sign of progress for 250 ms
   0.2600  robot    status from=standard to=local_recovery silent_ms=250 reason=cloud-1 no sign of progress for 250 ms
   0.2600  robot    launch service=local
   0.2600  local    is launched
   0.2600  robot    retry service=cloud-1 step=0 attempt=2 waited_ms=259
   0.2600  robot    asks cloud-1, call 2
   0.2600  robot    holding step=0 reason=cloud-1: no sign of progress for 250 ms; local: is being launched
   0.4100  local    starts, process 1
   0.4130  robot    hears of call 1: SensingAnswer
   0.4130  robot    resumed held_ms=153
   0.4130  robot    status from=local_recovery to=keep_alive outage_ms=153 reason=cloud-1 has answered
   0.4130  robot    performs sensing action 0 of step 0
   0.4130  robot    hears of call 1: its end
   0.4140  robot    asks cloud-1, call 3
   0.4200  robot    launched launch_ms=160
   0.6600  robot    hears of call 2: SensingAnswer
   0.6600  robot    hears of call 2: its end
   0.8150  robot    hears of call 3: TaskAnswer
   0.8150  robot    performs task action 0
   0.8180  robot    hears of call 3: SensingAnswer
   0.8180  robot    hears of call 3: its end
   0.8252  robot    performs task actions 1 to 8
   0.9068  robot    performs sensing action 0 of step 9
   0.9078  robot    asks cloud-1, call 4
   1.1578  robot    service_suspected service=cloud-1 reason=no sign of progress for 250 ms
   1.1578  robot    status from=keep_alive to=local_recovery silent_ms=250 reason=cloud-1 no sign of progress for 250 ms
   1.1578  robot    restore service=local step=9 bytes=1575
   1.1578  robot    retry service=local step=9 attempt=2 waited_ms=250
   1.1578  robot    asks local, call 5
   1.1590  robot    hears of call 5: TaskAnswer
   1.1590  robot    restored service=local step=9 restore_ms=1.2
   1.1590  robot    asks cloud-1, call 6
   1.1590  robot    performs task action 9
   1.1620  robot    hears of call 5: SensingAnswer
   1.1620  robot    hears of call 5: its end
   1.1692  robot    performs task actions 10 to 17
   1.2508  robot    performs sensing action 0 of step 18
   1.2518  robot    asks local, call 7
   1.2530  robot    hears of call 7: TaskAnswer
   1.2530  robot    performs task action 18
   1.2560  robot    hears of call 7: SensingAnswer
   1.2560  robot    hears of call 7: its end
   1.2632  robot    performs task actions 19 to 23
   1.3088  robot    hears of call 4: TaskAnswer
   1.3088  robot    late_replies service=cloud-1 soonest_ms=401 reason=several in a row took longer than offload.detection_timeout_ms (250), so it is given up and tried again with each turn; if it is that far away, raise the setting above the way there and back
   1.3088  robot    status from=local_recovery to=keep_alive outage_ms=151 reason=cloud-1 has answered
   1.3118  robot    hears of call 4: SensingAnswer
   1.3118  robot    hears of call 4: its end
   1.3142  robot    performs task actions 24 to 26
   1.3448  robot    performs sensing action 0 of step 27
   1.3458  robot    asks cloud-1, call 8
   1.5590  robot    hears of call 6: TaskAnswer
   1.5590  robot    hears of call 6: SensingAnswer
   1.5590  robot    hears of call 6: its end
   1.7468  robot    hears of call 8: TaskAnswer
   1.7468  robot    performs task action 27
   1.7498  robot    hears of call 8: SensingAnswer
   1.7498  robot    hears of call 8: its end
   1.7570  robot    performs task actions 28 to 35
   1.8386  robot    performs sensing action 0 of step 36
   1.8396  robot    asks cloud-1, call 9
   2.0896  robot    service_suspected service=cloud-1 reason=no sign of progress for 250 ms
   2.0896  robot    status from=keep_alive to=local_recovery silent_ms=250 reason=cloud-1 no sign of progress for 250 ms
   2.0896  robot    retry service=local step=36 attempt=2 waited_ms=250
   2.0896  robot    asks local, call 10
   2.0908  robot    hears of call 10: TaskAnswer
   2.0908  robot    asks cloud-1, call 11
   2.0908  robot    performs task action 36
   2.0938  robot    hears of call 10: SensingAnswer
   2.0938  robot    hears of call 10: its end
   2.1010  robot    performs task actions 37 to 39
   2.1316  robot    ends trial 3 after 40 steps

decided as without faults
