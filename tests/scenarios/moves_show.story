# Each move is measured, and a switch feels the ground: the next action depends on it, so each is
# asked for by itself. The last move before the crash is not known to the robot's process any more,
# but to its body.
run trial=1 moves_show=true remembers=true
kill_robot boundary=60 down_s=0.05 body_goes_on=true
crash service=cloud-1 at=0.3 down_s=0.3
----
   0.0000  cloud-1  starts, process 1
   0.0010  robot    begins trial 1 at step 0
   0.0100  robot    service_appeared service=cloud-1
   0.0100  robot    asks cloud-1, call 1
   0.0150  robot    hears of call 1: SensingAnswer
   0.0150  robot    performs sensing action 0 of step 0
   0.0150  robot    hears of call 1: its end
   0.0160  robot    asks cloud-1, call 2
   0.0190  robot    hears of call 2: TaskAnswer
   0.0190  robot    performs task action 0
   0.0190  robot    hears of call 2: its end
   0.0292  robot    asks cloud-1, call 3
   0.0322  robot    hears of call 3: TaskAnswer
   0.0322  robot    performs task action 1
   0.0322  robot    hears of call 3: its end
   0.0424  robot    asks cloud-1, call 4
   0.0454  robot    hears of call 4: TaskAnswer
   0.0454  robot    performs task action 2
   0.0454  robot    hears of call 4: its end
   0.0556  robot    asks cloud-1, call 5
   0.0586  robot    hears of call 5: TaskAnswer
   0.0586  robot    performs task action 3
   0.0586  robot    hears of call 5: its end
   0.0688  robot    asks cloud-1, call 6
   0.0718  robot    hears of call 6: TaskAnswer
   0.0718  robot    performs task action 4
   0.0718  robot    hears of call 6: its end
   0.0820  robot    asks cloud-1, call 7
   0.0850  robot    hears of call 7: TaskAnswer
   0.0850  robot    performs task action 5
   0.0850  robot    hears of call 7: its end
   0.0952  robot    asks cloud-1, call 8
   0.0982  robot    hears of call 8: TaskAnswer
   0.0982  robot    performs task action 6
   0.0982  robot    hears of call 8: its end
   0.1084  robot    asks cloud-1, call 9
   0.1114  robot    hears of call 9: TaskAnswer
   0.1114  robot    performs task action 7
   0.1114  robot    hears of call 9: its end
   0.1216  robot    asks cloud-1, call 10
   0.1246  robot    hears of call 10: TaskAnswer
   0.1246  robot    performs task action 8
   0.1246  robot    hears of call 10: its end
   0.1348  robot    asks cloud-1, call 11
   0.1398  robot    hears of call 11: SensingAnswer
   0.1398  robot    performs sensing action 2 of step 9
   0.1398  robot    hears of call 11: its end
   0.1408  robot    asks cloud-1, call 12
   0.1438  robot    hears of call 12: TaskAnswer
   0.1438  robot    performs task action 9
   0.1438  robot    hears of call 12: its end
   0.1540  robot    asks cloud-1, call 13
   0.1570  robot    hears of call 13: TaskAnswer
   0.1570  robot    performs task action 10
   0.1570  robot    hears of call 13: its end
   0.1672  robot    asks cloud-1, call 14
   0.1702  robot    hears of call 14: TaskAnswer
   0.1702  robot    performs task action 11
   0.1702  robot    hears of call 14: its end
   0.1804  robot    asks cloud-1, call 15
   0.1834  robot    hears of call 15: TaskAnswer
   0.1834  robot    performs task action 12
   0.1834  robot    hears of call 15: its end
   0.1936  robot    asks cloud-1, call 16
   0.1966  robot    hears of call 16: TaskAnswer
   0.1966  robot    is killed
   0.2466  robot    is started again
   0.2476  robot    begins trial 1 at step 13
   0.2476  robot    resumed_trial trial=1 step=13
   0.2476  robot    performs task action 13
   0.2566  robot    service_appeared service=cloud-1
   0.2578  robot    restore service=cloud-1 step=14 bytes=1578
   0.2578  robot    asks cloud-1, call 1
   0.2608  robot    hears of call 1: TaskAnswer
   0.2608  robot    restored service=cloud-1 step=14 restore_ms=3
   0.2608  robot    performs task action 14
   0.2608  robot    hears of call 1: its end
   0.2710  robot    asks cloud-1, call 2
   0.2740  robot    hears of call 2: TaskAnswer
   0.2740  robot    performs task action 15
   0.2740  robot    hears of call 2: its end
   0.2842  robot    asks cloud-1, call 3
   0.2872  robot    hears of call 3: TaskAnswer
   0.2872  robot    performs task action 16
   0.2872  robot    hears of call 3: its end
   0.2974  robot    asks cloud-1, call 4
   0.3000  cloud-1  is killed
   0.3004  robot    hears of call 4: TaskAnswer
   0.3004  robot    performs task action 17
   0.3004  robot    hears of call 4: its end
   0.3020  robot    service_vanished service=cloud-1
   0.3020  robot    status from=standard to=local_recovery silent_ms=1.6 reason=cloud-1 is gone
   0.3020  robot    launch service=local
   0.3020  local    is launched
   0.3106  robot    holding step=18 reason=cloud-1: is not there; local: is being launched
   0.4520  local    starts, process 1
   0.4620  robot    launched launch_ms=160
   0.4620  robot    restore service=local step=18 bytes=1578
   0.4620  robot    asks local, call 5
   0.4652  robot    hears of call 5: SensingAnswer
   0.4652  robot    restored service=local step=18 restore_ms=3.2
   0.4652  robot    resumed held_ms=154.6
   0.4652  robot    performs sensing action 0 of step 18
   0.4652  robot    hears of call 5: its end
   0.4662  robot    asks local, call 6
   0.4674  robot    hears of call 6: TaskAnswer
   0.4674  robot    performs task action 18
   0.4674  robot    hears of call 6: its end
   0.4776  robot    asks local, call 7
   0.4788  robot    hears of call 7: TaskAnswer
   0.4788  robot    performs task action 19
   0.4788  robot    hears of call 7: its end
   0.4890  robot    asks local, call 8
   0.4902  robot    hears of call 8: TaskAnswer
   0.4902  robot    performs task action 20
   0.4902  robot    hears of call 8: its end
   0.5004  robot    asks local, call 9
   0.5016  robot    hears of call 9: TaskAnswer
   0.5016  robot    performs task action 21
   0.5016  robot    hears of call 9: its end
   0.5118  robot    asks local, call 10
   0.5130  robot    hears of call 10: TaskAnswer
   0.5130  robot    performs task action 22
   0.5130  robot    hears of call 10: its end
   0.5232  robot    asks local, call 11
   0.5244  robot    hears of call 11: TaskAnswer
   0.5244  robot    performs task action 23
   0.5244  robot    hears of call 11: its end
   0.5346  robot    asks local, call 12
   0.5358  robot    hears of call 12: TaskAnswer
   0.5358  robot    performs task action 24
   0.5358  robot    hears of call 12: its end
   0.5460  robot    asks local, call 13
   0.5472  robot    hears of call 13: TaskAnswer
   0.5472  robot    performs task action 25
   0.5472  robot    hears of call 13: its end
   0.5574  robot    asks local, call 14
   0.5586  robot    hears of call 14: TaskAnswer
   0.5586  robot    performs task action 26
   0.5586  robot    hears of call 14: its end
   0.5688  robot    asks local, call 15
   0.5720  robot    hears of call 15: SensingAnswer
   0.5720  robot    performs sensing action 2 of step 27
   0.5720  robot    hears of call 15: its end
   0.5730  robot    asks local, call 16
   0.5742  robot    hears of call 16: TaskAnswer
   0.5742  robot    performs task action 27
   0.5742  robot    hears of call 16: its end
   0.5844  robot    asks local, call 17
   0.5856  robot    hears of call 17: TaskAnswer
   0.5856  robot    performs task action 28
   0.5856  robot    hears of call 17: its end
   0.5958  robot    asks local, call 18
   0.5970  robot    hears of call 18: TaskAnswer
   0.5970  robot    performs task action 29
   0.5970  robot    hears of call 18: its end
   0.6000  cloud-1  starts, process 2
   0.6072  robot    asks local, call 19
   0.6084  robot    hears of call 19: TaskAnswer
   0.6084  robot    performs task action 30
   0.6084  robot    hears of call 19: its end
   0.6100  robot    service_appeared service=cloud-1
   0.6100  robot    restore service=cloud-1 step=30 bytes=1578
   0.6100  robot    asks cloud-1, call 20
   0.6130  robot    hears of call 20: TaskAnswer
   0.6130  robot    restored service=cloud-1 step=30 restore_ms=3
   0.6130  robot    status from=local_recovery to=keep_alive outage_ms=311 reason=cloud-1 has answered
   0.6130  robot    hears of call 20: its end
   0.6186  robot    asks cloud-1, call 21
   0.6216  robot    hears of call 21: TaskAnswer
   0.6216  robot    performs task action 31
   0.6216  robot    hears of call 21: its end
   0.6318  robot    asks cloud-1, call 22
   0.6348  robot    hears of call 22: TaskAnswer
   0.6348  robot    performs task action 32
   0.6348  robot    hears of call 22: its end
   0.6450  robot    asks cloud-1, call 23
   0.6480  robot    hears of call 23: TaskAnswer
   0.6480  robot    performs task action 33
   0.6480  robot    hears of call 23: its end
   0.6582  robot    asks cloud-1, call 24
   0.6612  robot    hears of call 24: TaskAnswer
   0.6612  robot    performs task action 34
   0.6612  robot    hears of call 24: its end
   0.6714  robot    asks cloud-1, call 25
   0.6744  robot    hears of call 25: TaskAnswer
   0.6744  robot    performs task action 35
   0.6744  robot    hears of call 25: its end
   0.6846  robot    asks cloud-1, call 26
   0.6896  robot    hears of call 26: SensingAnswer
   0.6896  robot    performs sensing action 0 of step 36
   0.6896  robot    hears of call 26: its end
   0.6906  robot    asks cloud-1, call 27
   0.6936  robot    hears of call 27: TaskAnswer
   0.6936  robot    performs task action 36
   0.6936  robot    hears of call 27: its end
   0.7038  robot    asks cloud-1, call 28
   0.7068  robot    hears of call 28: TaskAnswer
   0.7068  robot    performs task action 37
   0.7068  robot    hears of call 28: its end
   0.7170  robot    asks cloud-1, call 29
   0.7200  robot    hears of call 29: TaskAnswer
   0.7200  robot    performs task action 38
   0.7200  robot    hears of call 29: its end
   0.7302  robot    asks cloud-1, call 30
   0.7332  robot    hears of call 30: TaskAnswer
   0.7332  robot    performs task action 39
   0.7332  robot    hears of call 30: its end
   0.7434  robot    ends trial 1 after 40 steps

decided as without faults
