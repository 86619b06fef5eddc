# A slow cloud with one worker is asked by two hundred new robots, while one that it serves goes on.
# It waits for none of them: they have a thread of their own. (They used to go in a row before it,
# once they had waited for a tenth of a second: it stood still for 14 s.)
run trial=3 replicas=2 workers=1 sensing_s=0.003 latency_s=0.001 act_s=0.01
slow service=cloud-1 at=0.1 for_s=60 factor=30
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
   0.1000  cloud-1  computes 30 times as long
   0.1006  robot    performs task action 8
   0.1108  robot    performs sensing action 0 of step 9
   0.1118  robot    asks cloud-1, call 3
   0.1438  robot    hears of call 3: TaskAnswer
   0.1438  robot    performs task actions 9 to 13
   0.1938  robot    hears of call 3: Progress
   0.1948  robot    performs task action 14
   0.2000  cloud-1  is asked by 200 other robots
   0.2050  robot    performs task actions 15 to 17
   0.2338  robot    hears of call 3: SensingAnswer
   0.2338  robot    hears of call 3: its end
   0.2356  robot    performs sensing action 0 of step 18
   0.2366  robot    asks cloud-1, call 4
   0.2686  robot    hears of call 4: TaskAnswer
   0.2686  robot    performs task actions 18 to 23
   0.3268  robot    hears of call 4: Progress
   0.3298  robot    performs task actions 24 to 26
   0.3586  robot    hears of call 4: SensingAnswer
   0.3586  robot    hears of call 4: its end
   0.3604  robot    performs sensing action 0 of step 27
   0.3614  robot    asks cloud-1, call 5
   0.3934  robot    hears of call 5: TaskAnswer
   0.3934  robot    performs task actions 27 to 32
   0.4502  robot    hears of call 5: Progress
   0.4546  robot    performs task actions 33 to 35
   0.4834  robot    hears of call 5: SensingAnswer
   0.4834  robot    hears of call 5: its end
   0.4852  robot    performs sensing action 0 of step 36
   0.4862  robot    asks cloud-1, call 6
   0.5182  robot    hears of call 6: TaskAnswer
   0.5182  robot    performs task actions 36 to 39
   0.5590  robot    ends trial 3 after 40 steps

decided as without faults
