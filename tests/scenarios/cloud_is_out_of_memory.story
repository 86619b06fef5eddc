# The cloud has no memory for sensing parts for a while. It gives task parts all the same, which does not excuse the refusals after
# them: it is asked ever later, meanwhile the local service decides, and then the cloud again.
run rate_hz=50
out_of_memory service=cloud-1 part=sensing at=0.03 for_s=0.5
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
   0.0300  cloud-1  has no memory for sensing parts
   0.0390  robot    performs task actions 1 to 8
   0.1892  robot    performs sensing action 0 of step 9
   0.1902  robot    asks cloud-1, call 3
   0.1932  robot    hears of call 3: TaskAnswer
   0.1962  robot    hears of call 3: Refused
   0.1962  robot    refused service=cloud-1 code=out_of_memory reason=out of memory for a sensing part final=False
   0.1990  robot    performs task actions 9 to 13
   0.2962  robot    restore service=cloud-1 step=9 bytes=1575
   0.2962  robot    retry service=cloud-1 step=9 attempt=2 waited_ms=0
   0.2962  robot    asks cloud-1, call 4
   0.2982  robot    hears of call 4: TaskAnswer
   0.2982  robot    restored service=cloud-1 step=9 restore_ms=2
   0.2990  robot    performs task action 14
   0.3012  robot    hears of call 4: Refused
   0.3012  robot    refused service=cloud-1 code=out_of_memory reason=out of memory for a sensing part final=False
   0.3190  robot    performs task actions 15 to 17
   0.5012  robot    restore service=cloud-1 step=9 bytes=1575
   0.5012  robot    retry service=cloud-1 step=9 attempt=3 waited_ms=132
   0.5012  robot    asks cloud-1, call 5
   0.5032  robot    hears of call 5: TaskAnswer
   0.5032  robot    restored service=cloud-1 step=9 restore_ms=2
   0.5062  robot    hears of call 5: Refused
   0.5062  robot    refused service=cloud-1 code=out_of_memory reason=out of memory for a sensing part final=False
   0.5062  robot    status from=standard to=local_recovery silent_ms=0 reason=cloud-1 out_of_memory: out of memory for a sensing part
   0.5062  robot    launch service=local
   0.5062  local    is launched
   0.5062  robot    holding step=9 reason=cloud-1: out_of_memory: out of memory for a sensing part; local: is being launched
   0.5300  cloud-1  has memory for sensing parts again
   0.6562  local    starts, process 1
   0.6662  robot    launched launch_ms=160
   0.6662  robot    restore service=local step=9 bytes=1575
   0.6662  robot    retry service=local step=9 attempt=4 waited_ms=297
   0.6662  robot    asks local, call 6
   0.6674  robot    hears of call 6: TaskAnswer
   0.6674  robot    restored service=local step=9 restore_ms=1.2
   0.6674  robot    resumed held_ms=161.2
   0.6704  robot    hears of call 6: SensingAnswer
   0.6704  robot    performs sensing action 0 of step 18
   0.6704  robot    hears of call 6: its end
   0.6714  robot    asks local, call 7
   0.6726  robot    hears of call 7: TaskAnswer
   0.6726  robot    missed_ticks missed=14 total=14
   0.6726  robot    performs task action 18
   0.6756  robot    hears of call 7: SensingAnswer
   0.6756  robot    hears of call 7: its end
   0.6828  robot    performs task actions 19 to 26
   0.8292  robot    performs sensing action 0 of step 27
   0.8302  robot    asks local, call 8
   0.8314  robot    hears of call 8: TaskAnswer
   0.8344  robot    hears of call 8: SensingAnswer
   0.8344  robot    hears of call 8: its end
   0.8390  robot    performs task actions 27 to 35
   1.0092  robot    performs sensing action 2 of step 36
   1.0102  robot    unexplained trial=0 step=36 sensing_action=2 deviations=41.5642 reason=more than 8 standard deviations from every particle
   1.0102  robot    asks local, call 9
   1.0102  robot    restore service=cloud-1 step=36 bytes=1575
   1.0102  robot    asks cloud-1, call 10
   1.0114  robot    hears of call 9: TaskAnswer
   1.0132  robot    hears of call 10: TaskAnswer
   1.0132  robot    restored service=cloud-1 step=36 restore_ms=3
   1.0132  robot    status from=local_recovery to=keep_alive outage_ms=507 reason=cloud-1 has answered
   1.0144  robot    hears of call 9: SensingAnswer
   1.0144  robot    hears of call 9: its end
   1.0162  robot    hears of call 10: SensingAnswer
   1.0162  robot    hears of call 10: its end
   1.0190  robot    performs task actions 36 to 39
   1.0892  robot    ends trial 0 after 40 steps

decided as without faults
