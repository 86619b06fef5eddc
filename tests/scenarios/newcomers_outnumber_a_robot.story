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
   0.1538  robot    hears of call 3: TaskAnswer
   0.1538  robot    performs task actions 9 to 13
   0.2000  cloud-1  is asked by 200 other robots
   0.2048  robot    performs task actions 14 to 15
   0.2171  robot    hears of call 3: Progress
   0.2252  robot    performs task actions 16 to 17
   0.2438  robot    hears of call 3: SensingAnswer
   0.2438  robot    hears of call 3: its end
   0.2456  robot    performs sensing action 0 of step 18
   0.2466  robot    asks cloud-1, call 4
   0.2786  robot    hears of call 4: TaskAnswer
   0.2786  robot    performs task actions 18 to 24
   0.3411  robot    hears of call 4: Progress
   0.3500  robot    performs task actions 25 to 26
   0.3686  robot    hears of call 4: SensingAnswer
   0.3686  robot    hears of call 4: its end
   0.3704  robot    performs sensing action 0 of step 27
   0.3714  robot    asks cloud-1, call 5
   0.4034  robot    hears of call 5: TaskAnswer
   0.4034  robot    performs task actions 27 to 33
   0.4651  robot    hears of call 5: Progress
   0.4748  robot    performs task actions 34 to 35
   0.4934  robot    hears of call 5: SensingAnswer
   0.4934  robot    hears of call 5: its end
   0.4952  robot    performs sensing action 0 of step 36
   0.4962  robot    asks cloud-1, call 6
   0.5282  robot    hears of call 6: TaskAnswer
   0.5282  robot    performs task actions 36 to 39
   0.5690  robot    ends trial 3 after 40 steps

decided as without faults
