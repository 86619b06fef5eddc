# The cloud is 40 ms away. The robot takes its task actions itself, so it moves on at once, and what to
# sense next is there before it is needed.
run what=sensing latency_s=0.02 rate_hz=100
----
   0.0000  cloud-1  starts, process 1
   0.0010  robot    begins trial 0 at step 0
   0.0100  robot    service_appeared service=cloud-1
   0.0100  robot    asks cloud-1, call 1
   0.0530  robot    hears of call 1: SensingAnswer
   0.0530  robot    performs sensing action 0 of step 0
   0.0530  robot    hears of call 1: its end
   0.0540  robot    asks cloud-1, call 2
   0.0540  robot    performs task actions 0 to 4
   0.0950  robot    hears of call 2: TaskAnswer
   0.0980  robot    hears of call 2: SensingAnswer
   0.0980  robot    hears of call 2: its end
   0.1050  robot    performs task actions 5 to 8
   0.1458  robot    performs sensing action 0 of step 9
   0.1468  robot    asks cloud-1, call 3
   0.1468  robot    performs task actions 9 to 13
   0.1878  robot    hears of call 3: TaskAnswer
   0.1908  robot    hears of call 3: SensingAnswer
   0.1908  robot    hears of call 3: its end
   0.1978  robot    performs task actions 14 to 17
   0.2386  robot    performs sensing action 0 of step 18
   0.2396  robot    asks cloud-1, call 4
   0.2396  robot    performs task actions 18 to 22
   0.2806  robot    hears of call 4: TaskAnswer
   0.2836  robot    hears of call 4: SensingAnswer
   0.2836  robot    hears of call 4: its end
   0.2906  robot    performs task actions 23 to 26
   0.3314  robot    performs sensing action 0 of step 27
   0.3324  robot    asks cloud-1, call 5
   0.3324  robot    performs task actions 27 to 31
   0.3734  robot    hears of call 5: TaskAnswer
   0.3764  robot    hears of call 5: SensingAnswer
   0.3764  robot    hears of call 5: its end
   0.3834  robot    performs task actions 32 to 35
   0.4242  robot    performs sensing action 2 of step 36
   0.4252  robot    unexplained trial=0 step=36 sensing_action=2 deviations=41.5642 reason=more than 8 standard deviations from every particle
   0.4252  robot    asks cloud-1, call 6
   0.4252  robot    missed_ticks missed=1 total=1
   0.4252  robot    performs task actions 36 to 39
   0.4660  robot    ends trial 0 after 40 steps

decided as without faults
