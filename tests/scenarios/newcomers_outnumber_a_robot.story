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
   0.3538  robot    hears of call 3: SensingAnswer
   0.3538  robot    performs sensing action 0 of step 18
   0.3538  robot    hears of call 3: its end
   0.3548  robot    asks cloud-1, call 4
   0.4201  robot    hears of call 4: Progress
   0.4834  robot    hears of call 4: Progress
   0.5459  robot    hears of call 4: Progress
   0.6084  robot    hears of call 4: Progress
   0.6709  robot    hears of call 4: Progress
   0.7326  robot    hears of call 4: Progress
   0.7738  robot    hears of call 4: TaskAnswer
   0.7738  robot    performs task actions 18 to 23
   0.8283  robot    hears of call 4: Progress
   0.8350  robot    performs task actions 24 to 26
   0.8901  robot    hears of call 4: Progress
   0.9518  robot    hears of call 4: Progress
   1.0127  robot    hears of call 4: Progress
   1.0737  robot    hears of call 4: Progress
   1.1338  robot    hears of call 4: SensingAnswer
   1.1338  robot    performs sensing action 0 of step 27
   1.1338  robot    hears of call 4: its end
   1.1348  robot    asks cloud-1, call 5
   1.1948  robot    hears of call 5: Progress
   1.2557  robot    hears of call 5: Progress
   1.3158  robot    hears of call 5: Progress
   1.3760  robot    hears of call 5: Progress
   1.4362  robot    hears of call 5: Progress
   1.4955  robot    hears of call 5: Progress
   1.5538  robot    hears of call 5: TaskAnswer
   1.5538  robot    performs task actions 27 to 32
   1.6132  robot    hears of call 5: Progress
   1.6150  robot    performs task actions 33 to 35
   1.6725  robot    hears of call 5: Progress
   1.7319  robot    hears of call 5: Progress
   1.7905  robot    hears of call 5: Progress
   1.8491  robot    hears of call 5: Progress
   1.9077  robot    hears of call 5: Progress
   1.9138  robot    hears of call 5: SensingAnswer
   1.9138  robot    performs sensing action 0 of step 36
   1.9138  robot    hears of call 5: its end
   1.9148  robot    asks cloud-1, call 6
   1.9663  robot    hears of call 6: Progress
   2.0249  robot    hears of call 6: Progress
   2.0835  robot    hears of call 6: Progress
   2.1413  robot    hears of call 6: Progress
   2.1991  robot    hears of call 6: Progress
   2.2569  robot    hears of call 6: Progress
   2.3140  robot    hears of call 6: Progress
   2.3338  robot    hears of call 6: TaskAnswer
   2.3338  robot    performs task actions 36 to 39
   2.3746  robot    ends trial 3 after 40 steps

decided as without faults
