# A stopped service had the answer to an old process ready, and the new one's request unread.
run act_s=0.02 latency_s=0.04 sensing_s=0.03 workers=1 certificates=true forgets_after_s=0.03
kill_robot boundary=16 before=send down_s=0.001
kill_robot at=0.543993 before=act down_s=0.05 body_goes_on=true
crowd service=cloud-1 at=0.129405 robots=20
stop node=cloud-1 at=0.611716 for_s=0.8
----
   0.0000  cloud-1  starts, process 1
   0.0010  robot    begins trial 0 at step 0
   0.0100  robot    service_appeared service=cloud-1
   0.0100  robot    asks cloud-1, call 1
   0.1200  robot    hears of call 1: SensingAnswer
   0.1200  robot    performs sensing action 0 of step 0
   0.1200  robot    hears of call 1: its end
   0.1210  robot    asks cloud-1, call 2
   0.1294  cloud-1  is asked by 20 other robots
   0.2010  robot    hears of call 2: NeedState
   0.2010  robot    restore service=cloud-1 step=0 bytes=1575
   0.2010  robot    asks cloud-1, call 3
   0.3204  robot    hears of call 3: TaskAnswer
   0.3204  robot    restored service=cloud-1 step=0 restore_ms=119.405
   0.3204  robot    performs task actions 0 to 1
   0.3504  robot    hears of call 3: SensingAnswer
   0.3504  robot    hears of call 3: its end
   0.3608  robot    performs task actions 2 to 8
   0.5022  robot    performs sensing action 0 of step 9
   0.5032  robot    is killed
   0.5042  robot    is started again
   0.5052  robot    begins trial 0 at step 9
   0.5052  robot    resumed_trial trial=0 step=9
   0.5142  robot    service_appeared service=cloud-1
   0.5142  robot    restore service=cloud-1 step=9 bytes=1575
   0.5142  robot    asks cloud-1, call 1
   0.5440  robot    is killed
   0.5940  robot    is started again
   0.5950  robot    begins trial 0 at step 9
   0.5950  robot    resumed_trial trial=0 step=9
   0.6040  robot    service_appeared service=cloud-1
   0.6040  robot    restore service=cloud-1 step=9 bytes=1575
   0.6040  robot    asks cloud-1, call 1
   0.6117  cloud-1  is stopped
   0.8540  robot    service_suspected service=cloud-1 reason=no sign of progress for 250 ms
   0.8540  robot    status from=standard to=local_recovery silent_ms=250 reason=cloud-1 no sign of progress for 250 ms
   0.8540  robot    launch service=local
   0.8540  local    is launched
   0.8540  robot    restore service=cloud-1 step=9 bytes=1575
   0.8540  robot    retry service=cloud-1 step=9 attempt=2 waited_ms=259
   0.8540  robot    asks cloud-1, call 2
   0.8540  robot    holding step=9 reason=cloud-1: no sign of progress for 250 ms; local: is being launched
   1.0040  local    starts, process 1
   1.0117  robot    service_vanished service=cloud-1
   1.0117  robot    hears of call 1: its end
   1.0117  robot    hears of call 2: its end
   1.0140  robot    launched launch_ms=160
   1.0140  robot    restore service=local step=9 bytes=1575
   1.0140  robot    retry service=local step=9 attempt=3 waited_ms=419
   1.0140  robot    asks local, call 3
   1.0442  robot    hears of call 3: SensingAnswer
   1.0442  robot    restored service=local step=9 restore_ms=30.2
   1.0442  robot    resumed held_ms=190.2
   1.0442  robot    performs sensing action 0 of step 9
   1.0442  robot    hears of call 3: its end
   1.0452  robot    asks local, call 4
   1.0464  robot    hears of call 4: TaskAnswer
   1.0464  robot    performs task actions 9 to 10
   1.0764  robot    hears of call 4: SensingAnswer
   1.0764  robot    hears of call 4: its end
   1.0868  robot    performs task actions 11 to 17
   1.2282  robot    performs sensing action 0 of step 18
   1.2292  robot    asks local, call 5
   1.2294  robot    hears of call 5: NeedState
   1.2294  robot    restore service=local step=18 bytes=1575
   1.2294  robot    asks local, call 6
   1.2306  robot    hears of call 6: TaskAnswer
   1.2306  robot    restored service=local step=18 restore_ms=1.2
   1.2306  robot    performs task actions 18 to 19
   1.2606  robot    hears of call 6: SensingAnswer
   1.2606  robot    hears of call 6: its end
   1.2710  robot    performs task actions 20 to 26
   1.4117  cloud-1  goes on
   1.4124  robot    performs sensing action 0 of step 27
   1.4134  robot    asks local, call 7
   1.4136  robot    hears of call 7: NeedState
   1.4136  robot    restore service=local step=27 bytes=1575
   1.4136  robot    asks local, call 8
   1.4148  robot    hears of call 8: TaskAnswer
   1.4148  robot    restored service=local step=27 restore_ms=1.2
   1.4148  robot    performs task action 27
   1.4217  robot    service_appeared service=cloud-1
   1.4217  robot    restore service=cloud-1 step=27 bytes=1575
   1.4217  robot    asks cloud-1, call 9
   1.4350  robot    performs task action 28
   1.4448  robot    hears of call 8: SensingAnswer
   1.4448  robot    hears of call 8: its end
   1.4552  robot    performs task actions 29 to 33
   1.5427  robot    hears of call 9: TaskAnswer
   1.5427  robot    restored service=cloud-1 step=27 restore_ms=121
   1.5427  robot    status from=local_recovery to=keep_alive outage_ms=688.723 reason=cloud-1 has answered
   1.5562  robot    performs task action 34
   1.5727  robot    hears of call 9: SensingAnswer
   1.5727  robot    hears of call 9: its end
   1.5764  robot    performs task action 35
   1.5966  robot    performs sensing action 2 of step 36
   1.5976  robot    asks cloud-1, call 10
   1.6776  robot    hears of call 10: NeedState
   1.6776  robot    restore service=cloud-1 step=36 bytes=1575
   1.6776  robot    asks cloud-1, call 11
   1.7586  robot    hears of call 11: TaskAnswer
   1.7586  robot    restored service=cloud-1 step=36 restore_ms=81
   1.7586  robot    performs task actions 36 to 37
   1.7886  robot    hears of call 11: SensingAnswer
   1.7886  robot    hears of call 11: its end
   1.7990  robot    performs task actions 38 to 39
   1.8394  robot    ends trial 0 after 40 steps

decided as without faults
