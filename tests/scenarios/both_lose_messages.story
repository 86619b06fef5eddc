# Found by the simulator. Messages of both services are lost again and again. The robot once waited
# for the silent local service for 8 and 16 seconds, and did not ask the cloud meanwhile.
run
kill_robot boundary=48
message service=cloud-1 direction=to number=0 what=drop
message service=cloud-1 direction=to number=1 what=drop
message service=cloud-1 direction=to number=3 what=drop
message service=cloud-1 direction=to number=4 what=drop
message service=cloud-1 direction=to number=5 what=drop
message service=cloud-1 direction=to number=6 what=drop
message service=cloud-1 direction=to number=7 what=drop
message service=cloud-1 direction=to number=8 what=drop
message service=cloud-1 direction=to number=9 what=drop
message service=local direction=to number=7 what=drop
message service=local direction=to number=8 what=drop
message service=local direction=to number=9 what=drop
message service=local direction=to number=13 what=drop
message service=local direction=from number=8 what=drop
message service=local direction=from number=9 what=drop
message service=local direction=from number=13 what=drop
message service=local direction=from number=19 what=drop
message service=local direction=from number=20 what=drop
message service=local direction=from number=22 what=drop
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
   0.4100  local    starts, process 1
   0.4200  robot    launched launch_ms=160
   0.4200  robot    retry service=local step=0 attempt=3 waited_ms=419
   0.4200  robot    asks local, call 3
   0.4232  robot    hears of call 3: SensingAnswer
   0.4232  robot    resumed held_ms=163.2
   0.4232  robot    performs sensing action 0 of step 0
   0.4232  robot    hears of call 3: its end
   0.4242  robot    asks local, call 4
   0.4254  robot    hears of call 4: TaskAnswer
   0.4254  robot    performs task action 0
   0.4284  robot    hears of call 4: SensingAnswer
   0.4284  robot    hears of call 4: its end
   0.4356  robot    performs task actions 1 to 8
   0.5172  robot    performs sensing action 0 of step 9
   0.5182  robot    asks local, call 5
   0.5182  robot    restore service=cloud-1 step=9 bytes=1575
   0.5182  robot    asks cloud-1, call 6
   0.5194  robot    hears of call 5: TaskAnswer
   0.5194  robot    performs task action 9
   0.5212  robot    hears of call 6: TaskAnswer
   0.5212  robot    restored service=cloud-1 step=9 restore_ms=3
   0.5212  robot    status from=local_recovery to=keep_alive outage_ms=261.2 reason=cloud-1 has answered
   0.5224  robot    hears of call 5: SensingAnswer
   0.5224  robot    hears of call 5: its end
   0.5242  robot    hears of call 6: SensingAnswer
   0.5242  robot    hears of call 6: its end
   0.5296  robot    performs task actions 10 to 16
   0.6010  robot    is killed
   0.8010  robot    is started again
   0.8020  robot    begins trial 0 at step 16
   0.8020  robot    resumed_trial trial=0 step=16
   0.8020  robot    performed_unseen trial=0 step=16
   0.8110  robot    service_appeared service=cloud-1
   0.8110  robot    restore service=cloud-1 step=17 bytes=1575
   0.8110  robot    asks cloud-1, call 1
   1.0610  robot    service_suspected service=cloud-1 reason=no sign of progress for 250 ms
   1.0610  robot    status from=standard to=local_recovery silent_ms=250 reason=cloud-1 no sign of progress for 250 ms
   1.0610  robot    launch service=local
   1.0610  local    is launched
   1.0610  robot    restore service=cloud-1 step=17 bytes=1575
   1.0610  robot    retry service=cloud-1 step=17 attempt=2 waited_ms=259
   1.0610  robot    asks cloud-1, call 2
   1.0610  robot    holding step=17 reason=cloud-1: no sign of progress for 250 ms; local: is being launched
   1.2110  local    starts, process 2
   1.2210  robot    launched launch_ms=160
   1.2210  robot    restore service=local step=17 bytes=1575
   1.2210  robot    retry service=local step=17 attempt=3 waited_ms=419
   1.2210  robot    asks local, call 3
   1.2252  robot    hears of call 3: its end
   1.2252  robot    service_suspected service=local reason=a call ended without the answer
   1.2452  robot    restore service=local step=17 bytes=1575
   1.2452  robot    retry service=local step=17 attempt=4 waited_ms=443.2
   1.2452  robot    asks local, call 4
   1.2454  robot    hears of call 4: TaskAnswer
   1.2454  robot    restored service=local step=17 restore_ms=0.2
   1.2454  robot    resumed held_ms=184.4
   1.2454  robot    performs task action 17
   1.2454  robot    hears of call 4: SensingAnswer
   1.2556  robot    performs sensing action 0 of step 18
   1.2566  robot    asks local, call 5
   1.2578  robot    hears of call 5: TaskAnswer
   1.2578  robot    performs task action 18
   1.2608  robot    hears of call 5: SensingAnswer
   1.2608  robot    hears of call 5: its end
   1.2680  robot    performs task actions 19 to 26
   1.3496  robot    performs sensing action 0 of step 27
   1.3506  robot    asks local, call 6
   1.3506  robot    restore service=cloud-1 step=27 bytes=1575
   1.3506  robot    asks cloud-1, call 7
   1.3518  robot    hears of call 6: TaskAnswer
   1.3518  robot    performs task action 27
   1.3548  robot    hears of call 6: SensingAnswer
   1.3620  robot    performs task actions 28 to 35
   1.4436  robot    performs sensing action 2 of step 36
   1.4446  robot    unexplained trial=0 step=36 sensing_action=2 deviations=41.5642 reason=more than 8 standard deviations from every particle
   1.4446  robot    asks local, call 8
   1.6006  robot    restore service=cloud-1 step=36 bytes=1575
   1.6006  robot    asks cloud-1, call 9
   1.8506  robot    restore service=cloud-1 step=36 bytes=1575
   1.8506  robot    asks cloud-1, call 10
   2.1006  robot    restore service=cloud-1 step=36 bytes=1575
   2.1006  robot    asks cloud-1, call 11
   2.3506  robot    restore service=cloud-1 step=36 bytes=1575
   2.3506  robot    asks cloud-1, call 12
   2.4446  robot    service_suspected service=local reason=no sign of progress for 1000 ms
   2.4446  robot    launch service=local
   2.4446  local    is launched
   2.4446  robot    holding step=36 reason=cloud-1: no sign of progress for 250 ms; local: is being launched
   2.4456  robot    hears of call 4: its end
   2.4456  robot    hears of call 6: its end
   2.5946  local    starts, process 3
   2.6006  robot    restore service=cloud-1 step=36 bytes=1575
   2.6006  robot    retry service=cloud-1 step=36 attempt=6 waited_ms=1156
   2.6006  robot    asks cloud-1, call 13
   2.6036  robot    hears of call 13: TaskAnswer
   2.6036  robot    restored service=cloud-1 step=36 restore_ms=3
   2.6036  robot    resumed held_ms=159
   2.6036  robot    status from=local_recovery to=keep_alive outage_ms=1542.6 reason=cloud-1 has answered
   2.6036  robot    waiting service=cloud-1 step=36 waited_ms=1159
   2.6036  robot    performs task action 36
   2.6046  robot    launched launch_ms=160
   2.6066  robot    hears of call 13: SensingAnswer
   2.6066  robot    hears of call 13: its end
   2.6138  robot    performs task actions 37 to 39
   2.6444  robot    ends trial 0 after 40 steps
never happened: message service=local direction=to number=8,9,13
never happened: message service=local direction=from number=20,22

decided as without faults
