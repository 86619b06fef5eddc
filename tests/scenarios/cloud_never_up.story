# The cloud is never there. After the time that it is given to appear, the local service is launched
# and decides all.
run
crash service=cloud-1 at=0 down_s=3600
----
   0.0000  cloud-1  starts, process 1
   0.0000  cloud-1  is killed
   0.0010  robot    begins trial 0 at step 0
   1.0000  robot    status from=standard to=local_recovery reason=cloud-1 has not appeared
   1.0000  robot    launch service=local
   1.0000  local    is launched
   1.0000  robot    holding step=0 reason=cloud-1: has not appeared; local: is being launched
   1.1500  local    starts, process 1
   1.1600  robot    launched launch_ms=160
   1.1600  robot    asks local, call 1
   1.1632  robot    hears of call 1: SensingAnswer
   1.1632  robot    resumed held_ms=163.2
   1.1632  robot    performs sensing action 0 of step 0
   1.1632  robot    hears of call 1: its end
   1.1642  robot    asks local, call 2
   1.1654  robot    hears of call 2: TaskAnswer
   1.1654  robot    performs task action 0
   1.1684  robot    hears of call 2: SensingAnswer
   1.1684  robot    hears of call 2: its end
   1.1756  robot    performs task actions 1 to 8
   1.2572  robot    performs sensing action 0 of step 9
   1.2582  robot    asks local, call 3
   1.2594  robot    hears of call 3: TaskAnswer
   1.2594  robot    performs task action 9
   1.2624  robot    hears of call 3: SensingAnswer
   1.2624  robot    hears of call 3: its end
   1.2696  robot    performs task actions 10 to 17
   1.3512  robot    performs sensing action 0 of step 18
   1.3522  robot    asks local, call 4
   1.3534  robot    hears of call 4: TaskAnswer
   1.3534  robot    performs task action 18
   1.3564  robot    hears of call 4: SensingAnswer
   1.3564  robot    hears of call 4: its end
   1.3636  robot    performs task actions 19 to 26
   1.4452  robot    performs sensing action 0 of step 27
   1.4462  robot    asks local, call 5
   1.4474  robot    hears of call 5: TaskAnswer
   1.4474  robot    performs task action 27
   1.4504  robot    hears of call 5: SensingAnswer
   1.4504  robot    hears of call 5: its end
   1.4576  robot    performs task actions 28 to 35
   1.5392  robot    performs sensing action 2 of step 36
   1.5402  robot    unexplained trial=0 step=36 sensing_action=2 deviations=41.5642 reason=more than 8 standard deviations from every particle
   1.5402  robot    asks local, call 6
   1.5414  robot    hears of call 6: TaskAnswer
   1.5414  robot    performs task action 36
   1.5444  robot    hears of call 6: SensingAnswer
   1.5444  robot    hears of call 6: its end
   1.5516  robot    performs task actions 37 to 39
   1.5822  robot    ends trial 0 after 40 steps

decided as without faults
