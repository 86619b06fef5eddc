# A stopped service had the answer to an old process ready, and the new one's request unread.
run act_s=0.02 latency_s=0.04 sensing_s=0.03 workers=1 certificates=true forgets_after_s=0.03
kill_robot boundary=16 before=send down_s=0.001
kill_robot at=0.513993 before=act down_s=0.05 body_goes_on=true
crowd service=cloud-1 at=0.129405 robots=20
stop node=cloud-1 at=0.581716 for_s=0.8
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
   0.2010  robot    restore service=cloud-1 step=0 bytes=1567
   0.2010  robot    asks cloud-1, call 3
   0.2904  robot    hears of call 3: TaskAnswer
   0.2904  robot    restored service=cloud-1 step=0 restore_ms=89.405
   0.2904  robot    performs task actions 0 to 2
   0.3404  robot    hears of call 3: Progress
   0.3504  robot    hears of call 3: SensingAnswer
   0.3504  robot    hears of call 3: its end
   0.3510  robot    performs task actions 3 to 8
   0.4722  robot    performs sensing action 0 of step 9
   0.4732  robot    is killed
   0.4742  robot    is started again
   0.4752  robot    begins trial 0 at step 9
   0.4752  robot    resumed_trial trial=0 step=9
   0.4842  robot    service_appeared service=cloud-1
   0.4842  robot    restore service=cloud-1 step=9 bytes=1567
   0.4842  robot    asks cloud-1, call 1
   0.5140  robot    is killed
   0.5640  robot    is started again
   0.5650  robot    begins trial 0 at step 9
   0.5650  robot    resumed_trial trial=0 step=9
   0.5740  robot    service_appeared service=cloud-1
   0.5740  robot    restore service=cloud-1 step=9 bytes=1567
   0.5740  robot    asks cloud-1, call 1
   0.5817  cloud-1  is stopped
   0.8240  robot    service_suspected service=cloud-1 reason=no sign of progress for 250 ms
   0.8240  robot    status from=standard to=local_recovery silent_ms=250 reason=cloud-1 no sign of progress for 250 ms
   0.8240  robot    launch service=local
   0.8240  local    is launched
   0.8240  robot    restore service=cloud-1 step=9 bytes=1567
   0.8240  robot    retry service=cloud-1 step=9 attempt=2 waited_ms=259
   0.8240  robot    asks cloud-1, call 2
   0.8240  robot    holding step=9 reason=cloud-1: no sign of progress for 250 ms; local: is being launched
   0.9740  local    starts, process 1
   0.9817  robot    service_vanished service=cloud-1
   0.9817  robot    hears of call 1: its end
   0.9817  robot    hears of call 2: its end
   0.9840  robot    launched launch_ms=160
   0.9840  robot    restore service=local step=9 bytes=1567
   0.9840  robot    retry service=local step=9 attempt=3 waited_ms=419
   0.9840  robot    asks local, call 3
   0.9852  robot    hears of call 3: TaskAnswer
   0.9852  robot    restored service=local step=9 restore_ms=1.2
   0.9852  robot    resumed held_ms=161.2
   0.9852  robot    performs task actions 9 to 10
   1.0152  robot    hears of call 3: SensingAnswer
   1.0152  robot    hears of call 3: its end
   1.0256  robot    performs task actions 11 to 17
   1.1670  robot    performs sensing action 0 of step 18
   1.1680  robot    asks local, call 4
   1.1682  robot    hears of call 4: NeedState
   1.1682  robot    restore service=local step=18 bytes=1567
   1.1682  robot    asks local, call 5
   1.1694  robot    hears of call 5: TaskAnswer
   1.1694  robot    restored service=local step=18 restore_ms=1.2
   1.1694  robot    performs task actions 18 to 19
   1.1994  robot    hears of call 5: SensingAnswer
   1.1994  robot    hears of call 5: its end
   1.2098  robot    performs task actions 20 to 26
   1.3512  robot    performs sensing action 0 of step 27
   1.3522  robot    asks local, call 6
   1.3524  robot    hears of call 6: NeedState
   1.3524  robot    restore service=local step=27 bytes=1567
   1.3524  robot    asks local, call 7
   1.3536  robot    hears of call 7: TaskAnswer
   1.3536  robot    restored service=local step=27 restore_ms=1.2
   1.3536  robot    performs task actions 27 to 28
   1.3817  cloud-1  goes on
   1.3836  robot    hears of call 7: SensingAnswer
   1.3836  robot    hears of call 7: its end
   1.3917  robot    service_appeared service=cloud-1
   1.3917  robot    restore service=cloud-1 step=27 bytes=1567
   1.3917  robot    asks cloud-1, call 8
   1.3940  robot    performs task actions 29 to 33
   1.4827  robot    hears of call 8: TaskAnswer
   1.4827  robot    restored service=cloud-1 step=27 restore_ms=91
   1.4827  robot    status from=local_recovery to=keep_alive outage_ms=658.723 reason=cloud-1 has answered
   1.4950  robot    performs task actions 34 to 35
   1.5327  robot    hears of call 8: Progress
   1.5354  robot    performs sensing action 2 of step 36
   1.5364  robot    unexplained trial=0 step=36 sensing_action=2 deviations=41.5642 reason=more than 8 standard deviations from every particle
   1.5364  robot    asks cloud-1, call 9
   1.6337  robot    hears of call 9: TaskAnswer
   1.6337  robot    performs task actions 36 to 37
   1.6637  robot    hears of call 9: SensingAnswer
   1.6637  robot    hears of call 9: its end
   1.6741  robot    performs task actions 38 to 39
   1.7145  robot    ends trial 0 after 40 steps

decided as without faults
