# A slow cloud with one worker is asked by two hundred new robots, while one that it serves goes on.
# Each of its requests waits for one newcomer at most. (They used to go in a row before it, once they
# had waited for a tenth of a second: it stood still for 14 s.)
run trial=3 replicas=2 workers=1 sensing_s=0.003 latency_s=0.001 act_s=0.01
slow service=cloud-1 at=0.1 for_s=60 factor=60
crowd service=cloud-1 at=0.2 robots=200
----
   0.0000  cloud-1  starts, process 1
   0.0000  cloud-2  starts, process 1
   0.0010  robot    begins trial 3 at step 0
   0.0100  robot    service_appeared service=cloud-1
   0.0100  robot    asks cloud-1, call 1
   0.0100  robot    service_appeared service=cloud-2
   0.0150  robot    hears of call 1: SensingAnswer
   0.0150  robot    performs sensing action 0 of step 0
   0.0150  robot    hears of call 1: its end
   0.0160  robot    asks cloud-1, call 2
   0.0190  robot    hears of call 2: TaskAnswer
   0.0190  robot    performs task action 0
   0.0220  robot    hears of call 2: SensingAnswer
   0.0220  robot    hears of call 2: its end
   0.0292  robot    performs task actions 1 to 7
   0.1000  cloud-1  computes 60 times as long
   0.1006  robot    performs task action 8
   0.1108  robot    performs sensing action 0 of step 9
   0.1118  robot    asks cloud-1, call 3
   0.1638  robot    hears of call 3: Progress
   0.1738  robot    hears of call 3: TaskAnswer
   0.1738  robot    performs task actions 9 to 11
   0.2000  cloud-1  is asked by 200 other robots
   0.2044  robot    performs task actions 12 to 15
   0.2371  robot    hears of call 3: Progress
   0.2452  robot    performs task actions 16 to 17
   0.3004  robot    hears of call 3: Progress
   0.3636  robot    hears of call 3: Progress
   0.4269  robot    hears of call 3: Progress
   0.4902  robot    hears of call 3: Progress
   0.5338  robot    hears of call 3: SensingAnswer
   0.5338  robot    performs sensing action 0 of step 18
   0.5338  robot    hears of call 3: its end
   0.5348  robot    asks cloud-1, call 4
   0.6001  robot    hears of call 4: Progress
   0.6634  robot    hears of call 4: Progress
   0.7259  robot    hears of call 4: Progress
   0.7884  robot    hears of call 4: Progress
   0.8509  robot    hears of call 4: Progress
   0.9126  robot    hears of call 4: Progress
   0.9538  robot    hears of call 4: TaskAnswer
   0.9538  robot    performs task actions 18 to 24
   1.0155  robot    hears of call 4: Progress
   1.0252  robot    performs task actions 25 to 26
   1.0765  robot    hears of call 4: Progress
   1.1374  robot    hears of call 4: Progress
   1.1983  robot    hears of call 4: Progress
   1.2593  robot    hears of call 4: Progress
   1.3194  robot    hears of call 4: Progress
   1.3796  robot    hears of call 4: Progress
   1.4397  robot    hears of call 4: Progress
   1.4938  robot    hears of call 4: SensingAnswer
   1.4938  robot    performs sensing action 0 of step 27
   1.4938  robot    hears of call 4: its end
   1.4948  robot    asks cloud-1, call 5
   1.5570  robot    hears of call 5: Progress
   1.6171  robot    hears of call 5: Progress
   1.6765  robot    hears of call 5: Progress
   1.7359  robot    hears of call 5: Progress
   1.7952  robot    hears of call 5: Progress
   1.8538  robot    hears of call 5: Progress
   1.9124  robot    hears of call 5: Progress
   1.9138  robot    hears of call 5: TaskAnswer
   1.9138  robot    performs task actions 27 to 32
   1.9710  robot    hears of call 5: Progress
   1.9750  robot    performs task actions 33 to 35
   2.0296  robot    hears of call 5: Progress
   2.0874  robot    hears of call 5: Progress
   2.1452  robot    hears of call 5: Progress
   2.2030  robot    hears of call 5: Progress
   2.2609  robot    hears of call 5: Progress
   2.3179  robot    hears of call 5: Progress
   2.3749  robot    hears of call 5: Progress
   2.4320  robot    hears of call 5: Progress
   2.4538  robot    hears of call 5: SensingAnswer
   2.4538  robot    performs sensing action 0 of step 36
   2.4538  robot    hears of call 5: its end
   2.4548  robot    asks cloud-1, call 6
   2.5138  robot    hears of call 6: Progress
   2.5709  robot    hears of call 6: Progress
   2.6279  robot    hears of call 6: Progress
   2.6841  robot    hears of call 6: Progress
   2.7404  robot    hears of call 6: Progress
   2.7966  robot    hears of call 6: Progress
   2.8521  robot    hears of call 6: Progress
   2.8738  robot    hears of call 6: TaskAnswer
   2.8738  robot    performs task actions 36 to 39
   2.9146  robot    ends trial 3 after 40 steps

decided as without faults
