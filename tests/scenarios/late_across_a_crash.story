# The robot dies while an observation is on its way, and with an action written down that it has not
# performed. Its next process is told what has come meanwhile, writes it down, and performs the
# action that was chosen without it. The third process reads all of that.
run senses_on=true
late step=0 moves=20
kill_robot boundary=10 before=act down_s=0.05
kill_robot at=0.3 down_s=0.05
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
   0.0292  robot    performs task actions 1 to 2
   0.0496  robot    is killed
   0.0996  robot    is started again
   0.1006  robot    begins trial 0 at step 3
   0.1006  robot    is shown what was sensed in step 0
   0.1006  robot    resumed_trial trial=0 step=3
   0.1006  robot    performs task action 3
   0.1096  robot    service_appeared service=cloud-1
   0.1108  robot    restore service=cloud-1 step=4 bytes=1575
   0.1108  robot    asks cloud-1, call 1
   0.1138  robot    hears of call 1: TaskAnswer
   0.1138  robot    restored service=cloud-1 step=4 restore_ms=3
   0.1138  robot    performs task action 4
   0.1168  robot    hears of call 1: SensingAnswer
   0.1168  robot    hears of call 1: its end
   0.1240  robot    performs task actions 5 to 8
   0.1648  robot    performs sensing action 0 of step 9
   0.1658  robot    asks cloud-1, call 2
   0.1688  robot    hears of call 2: TaskAnswer
   0.1688  robot    performs task action 9
   0.1718  robot    hears of call 2: SensingAnswer
   0.1718  robot    hears of call 2: its end
   0.1790  robot    performs task actions 10 to 17
   0.2606  robot    performs sensing action 0 of step 18
   0.2616  robot    asks cloud-1, call 3
   0.2646  robot    hears of call 3: TaskAnswer
   0.2646  robot    performs task action 18
   0.2676  robot    hears of call 3: SensingAnswer
   0.2676  robot    hears of call 3: its end
   0.2748  robot    performs task actions 19 to 21
   0.3000  robot    is killed
   0.3500  robot    is started again
   0.3510  robot    begins trial 0 at step 21
   0.3510  robot    resumed_trial trial=0 step=21
   0.3510  robot    performed_unseen trial=0 step=21
   0.3600  robot    service_appeared service=cloud-1
   0.3600  robot    restore service=cloud-1 step=22 bytes=1575
   0.3600  robot    asks cloud-1, call 1
   0.3630  robot    hears of call 1: TaskAnswer
   0.3630  robot    restored service=cloud-1 step=22 restore_ms=3
   0.3630  robot    performs task action 22
   0.3630  robot    hears of call 1: SensingAnswer
   0.3630  robot    hears of call 1: its end
   0.3732  robot    performs task actions 23 to 26
   0.4140  robot    performs sensing action 0 of step 27
   0.4150  robot    asks cloud-1, call 2
   0.4180  robot    hears of call 2: TaskAnswer
   0.4180  robot    performs task action 27
   0.4210  robot    hears of call 2: SensingAnswer
   0.4210  robot    hears of call 2: its end
   0.4282  robot    performs task actions 28 to 35
   0.5098  robot    performs sensing action 2 of step 36
   0.5108  robot    unexplained trial=0 step=36 sensing_action=2 deviations=41.5642 reason=more than 8 standard deviations from every particle
   0.5108  robot    asks cloud-1, call 3
   0.5138  robot    hears of call 3: TaskAnswer
   0.5138  robot    performs task action 36
   0.5168  robot    hears of call 3: SensingAnswer
   0.5168  robot    hears of call 3: its end
   0.5240  robot    performs task actions 37 to 39
   0.5546  robot    ends trial 0 after 40 steps

decided as without faults
