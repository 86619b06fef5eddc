# Found by the simulator. A reply is lost in a cut that is too short to break the link. Its call stayed
# open, so the first service was suspected of silence again and again, and the second one decided.
run trial=49 replicas=2 launch=at_start act_s=0.1 sensing_s=0.03
cut service=cloud-1 at=0.029476 for_s=0.1
----
   0.0000  cloud-1  starts, process 1
   0.0000  cloud-2  starts, process 1
   0.0000  robot    launch service=local
   0.0000  local    is launched
   0.0010  robot    begins trial 49 at step 0
   0.0100  robot    service_appeared service=cloud-1
   0.0100  robot    asks cloud-1, call 1
   0.0100  robot    service_appeared service=cloud-2
   0.0295  cloud-1  is cut off (both)
   0.1500  local    starts, process 1
   0.1600  robot    launched launch_ms=160
   0.2600  robot    service_suspected service=cloud-1 reason=no sign of progress for 250 ms
   0.2600  robot    retry service=cloud-2 step=0 attempt=2 waited_ms=259
   0.2600  robot    asks cloud-2, call 2
   0.2920  robot    hears of call 2: SensingAnswer
   0.2920  robot    performs sensing action 0 of step 0
   0.2920  robot    hears of call 2: its end
   0.2930  robot    asks cloud-2, call 3
   0.2930  robot    restore service=cloud-1 step=0 bytes=1575
   0.2930  robot    asks cloud-1, call 4
   0.2960  robot    hears of call 3: TaskAnswer
   0.2960  robot    performs task action 0
   0.2960  robot    hears of call 4: TaskAnswer
   0.2960  robot    restored service=cloud-1 step=0 restore_ms=3
   0.3260  robot    hears of call 3: SensingAnswer
   0.3260  robot    hears of call 3: its end
   0.3260  robot    hears of call 4: SensingAnswer
   0.3260  robot    hears of call 4: its end
   0.3962  robot    performs task actions 1 to 8
   1.1978  robot    performs sensing action 0 of step 9
   1.1988  robot    asks cloud-1, call 5
   1.2018  robot    hears of call 5: TaskAnswer
   1.2018  robot    performs task action 9
   1.2318  robot    hears of call 5: SensingAnswer
   1.2318  robot    hears of call 5: its end
   1.3020  robot    performs task actions 10 to 17
   2.1036  robot    performs sensing action 0 of step 18
   2.1046  robot    asks cloud-1, call 6
   2.1076  robot    hears of call 6: TaskAnswer
   2.1076  robot    performs task action 18
   2.1376  robot    hears of call 6: SensingAnswer
   2.1376  robot    hears of call 6: its end
   2.2078  robot    performs task actions 19 to 26
   3.0094  robot    performs sensing action 0 of step 27
   3.0104  robot    asks cloud-1, call 7
   3.0134  robot    hears of call 7: TaskAnswer
   3.0134  robot    performs task action 27
   3.0434  robot    hears of call 7: SensingAnswer
   3.0434  robot    hears of call 7: its end
   3.1136  robot    performs task actions 28 to 35
   3.9152  robot    performs sensing action 0 of step 36
   3.9162  robot    asks cloud-1, call 8
   3.9192  robot    hears of call 8: TaskAnswer
   3.9192  robot    performs task action 36
   3.9492  robot    hears of call 8: SensingAnswer
   3.9492  robot    hears of call 8: its end
   4.0194  robot    performs task actions 37 to 39
   4.3200  robot    ends trial 49 after 40 steps

decided as without faults
