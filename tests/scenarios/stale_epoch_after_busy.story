# Found by the simulator. A request of the robot's process before comes late, to a service that was too
# busy for the next process and did not remember that there is one. It answered.
run sessions_kept=2 forgets_after_s=0.03
message service=cloud-1 direction=to number=0 what=delay seconds=0.6
kill_robot boundary=9 before=journal down_s=0.6 body_goes_on=true
crowd service=cloud-1 at=0.34372 robots=20
kill_robot at=0.204675 down_s=0.05 body_goes_on=true
----
   0.0000  cloud-1  starts, process 1
   0.0010  robot    begins trial 0 at step 0
   0.0100  robot    service_appeared service=cloud-1
   0.0100  robot    asks cloud-1, call 1
   0.2047  robot    is killed
   0.2547  robot    is started again
   0.2557  robot    begins trial 0 at step 0
   0.2647  robot    service_appeared service=cloud-1
   0.2647  robot    asks cloud-1, call 1
   0.2697  robot    hears of call 1: SensingAnswer
   0.2697  robot    performs sensing action 0 of step 0
   0.2697  robot    hears of call 1: its end
   0.2707  robot    asks cloud-1, call 2
   0.2737  robot    hears of call 2: TaskAnswer
   0.2737  robot    performs task action 0
   0.2767  robot    hears of call 2: SensingAnswer
   0.2767  robot    hears of call 2: its end
   0.2839  robot    performs task action 1
   0.2941  robot    is killed
   0.3437  cloud-1  is asked by 20 other robots
   0.8941  robot    is started again
   0.8951  robot    begins trial 0 at step 1
   0.8951  robot    resumed_trial trial=0 step=1
   0.8951  robot    performed_unseen trial=0 step=1
   0.9041  robot    service_appeared service=cloud-1
   0.9041  robot    restore service=cloud-1 step=2 bytes=1575
   0.9041  robot    asks cloud-1, call 1
   0.9071  robot    hears of call 1: TaskAnswer
   0.9071  robot    restored service=cloud-1 step=2 restore_ms=3
   0.9071  robot    performs task action 2
   0.9101  robot    hears of call 1: SensingAnswer
   0.9101  robot    hears of call 1: its end
   0.9173  robot    performs task actions 3 to 8
   0.9785  robot    performs sensing action 0 of step 9
   0.9795  robot    asks cloud-1, call 2
   0.9815  robot    hears of call 2: NeedState
   0.9815  robot    restore service=cloud-1 step=9 bytes=1575
   0.9815  robot    asks cloud-1, call 3
   0.9845  robot    hears of call 3: TaskAnswer
   0.9845  robot    restored service=cloud-1 step=9 restore_ms=3
   0.9845  robot    performs task action 9
   0.9875  robot    hears of call 3: SensingAnswer
   0.9875  robot    hears of call 3: its end
   0.9947  robot    performs task actions 10 to 17
   1.0763  robot    performs sensing action 0 of step 18
   1.0773  robot    asks cloud-1, call 4
   1.0793  robot    hears of call 4: NeedState
   1.0793  robot    restore service=cloud-1 step=18 bytes=1575
   1.0793  robot    asks cloud-1, call 5
   1.0823  robot    hears of call 5: TaskAnswer
   1.0823  robot    restored service=cloud-1 step=18 restore_ms=3
   1.0823  robot    performs task action 18
   1.0853  robot    hears of call 5: SensingAnswer
   1.0853  robot    hears of call 5: its end
   1.0925  robot    performs task actions 19 to 26
   1.1741  robot    performs sensing action 0 of step 27
   1.1751  robot    asks cloud-1, call 6
   1.1771  robot    hears of call 6: NeedState
   1.1771  robot    restore service=cloud-1 step=27 bytes=1575
   1.1771  robot    asks cloud-1, call 7
   1.1801  robot    hears of call 7: TaskAnswer
   1.1801  robot    restored service=cloud-1 step=27 restore_ms=3
   1.1801  robot    performs task action 27
   1.1831  robot    hears of call 7: SensingAnswer
   1.1831  robot    hears of call 7: its end
   1.1903  robot    performs task actions 28 to 35
   1.2719  robot    performs sensing action 2 of step 36
   1.2729  robot    unexplained trial=0 step=36 sensing_action=2 deviations=41.5642 reason=more than 8 standard deviations from every particle
   1.2729  robot    asks cloud-1, call 8
   1.2749  robot    hears of call 8: NeedState
   1.2749  robot    restore service=cloud-1 step=36 bytes=1575
   1.2749  robot    asks cloud-1, call 9
   1.2779  robot    hears of call 9: TaskAnswer
   1.2779  robot    restored service=cloud-1 step=36 restore_ms=3
   1.2779  robot    performs task action 36
   1.2809  robot    hears of call 9: SensingAnswer
   1.2809  robot    hears of call 9: its end
   1.2881  robot    performs task actions 37 to 39
   1.3187  robot    ends trial 0 after 40 steps

decided as without faults
