# Messages are damaged on their way, in both directions: they are asked for again.
run
message service=cloud-1 direction=to number=1 what=corrupt bit=77
message service=cloud-1 direction=from number=4 what=corrupt bit=199
----
   0.0000  cloud-1  starts, process 1
   0.0010  robot    begins trial 0 at step 0
   0.0100  robot    service_appeared service=cloud-1
   0.0100  robot    asks cloud-1, call 1
   0.0150  robot    hears of call 1: SensingAnswer
   0.0150  robot    performs sensing action 0 of step 0
   0.0150  robot    hears of call 1: its end
   0.0160  robot    asks cloud-1, call 2
   0.0180  robot    hears of call 2: Refused
   0.0180  robot    damaged_request service=cloud-1 reason=68 bytes do not have the checksum that they end with
   0.0380  robot    retry service=cloud-1 step=0 attempt=2 waited_ms=22
   0.0380  robot    asks cloud-1, call 3
   0.0410  robot    hears of call 3: damaged
   0.0410  robot    malformed_reply service=cloud-1 reason=233 bytes do not have the checksum that they end with
   0.0810  robot    retry service=cloud-1 step=0 attempt=3 waited_ms=65
   0.0810  robot    asks cloud-1, call 4
   0.0830  robot    hears of call 4: TaskAnswer
   0.0830  robot    performs task action 0
   0.0830  robot    hears of call 4: SensingAnswer
   0.0830  robot    hears of call 4: its end
   0.0932  robot    performs task actions 1 to 8
   0.1748  robot    performs sensing action 0 of step 9
   0.1758  robot    asks cloud-1, call 5
   0.1788  robot    hears of call 5: TaskAnswer
   0.1788  robot    performs task action 9
   0.1818  robot    hears of call 5: SensingAnswer
   0.1818  robot    hears of call 5: its end
   0.1890  robot    performs task actions 10 to 17
   0.2706  robot    performs sensing action 0 of step 18
   0.2716  robot    asks cloud-1, call 6
   0.2746  robot    hears of call 6: TaskAnswer
   0.2746  robot    performs task action 18
   0.2776  robot    hears of call 6: SensingAnswer
   0.2776  robot    hears of call 6: its end
   0.2848  robot    performs task actions 19 to 26
   0.3664  robot    performs sensing action 0 of step 27
   0.3674  robot    asks cloud-1, call 7
   0.3704  robot    hears of call 7: TaskAnswer
   0.3704  robot    performs task action 27
   0.3734  robot    hears of call 7: SensingAnswer
   0.3734  robot    hears of call 7: its end
   0.3806  robot    performs task actions 28 to 35
   0.4622  robot    performs sensing action 2 of step 36
   0.4632  robot    unexplained trial=0 step=36 sensing_action=2 deviations=41.5642 reason=more than 8 standard deviations from every particle
   0.4632  robot    asks cloud-1, call 8
   0.4662  robot    hears of call 8: TaskAnswer
   0.4662  robot    performs task action 36
   0.4692  robot    hears of call 8: SensingAnswer
   0.4692  robot    hears of call 8: its end
   0.4764  robot    performs task actions 37 to 39
   0.5070  robot    ends trial 0 after 40 steps

decided as without faults
