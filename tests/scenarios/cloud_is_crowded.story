# Sixty other robots ask the cloud at once. The robot, which was served before, does not wait for all
# of them.
run sensing_s=0.03
crowd service=cloud-1 at=0.18 robots=60
----
   0.0000  cloud-1  starts, process 1
   0.0010  robot    begins trial 0 at step 0
   0.0100  robot    service_appeared service=cloud-1
   0.0100  robot    asks cloud-1, call 1
   0.0420  robot    hears of call 1: SensingAnswer
   0.0420  robot    performs sensing action 0 of step 0
   0.0420  robot    hears of call 1: its end
   0.0430  robot    asks cloud-1, call 2
   0.0460  robot    hears of call 2: TaskAnswer
   0.0460  robot    performs task actions 0 to 2
   0.0760  robot    hears of call 2: SensingAnswer
   0.0760  robot    hears of call 2: its end
   0.0766  robot    performs task actions 3 to 8
   0.1378  robot    performs sensing action 0 of step 9
   0.1388  robot    asks cloud-1, call 3
   0.1418  robot    hears of call 3: TaskAnswer
   0.1418  robot    performs task actions 9 to 11
   0.1718  robot    hears of call 3: SensingAnswer
   0.1718  robot    hears of call 3: its end
   0.1724  robot    performs task action 12
   0.1800  cloud-1  is asked by 60 other robots
   0.1826  robot    performs task actions 13 to 17
   0.2336  robot    performs sensing action 0 of step 18
   0.2346  robot    asks cloud-1, call 4
   0.2376  robot    hears of call 4: TaskAnswer
   0.2376  robot    performs task actions 18 to 20
   0.2676  robot    hears of call 4: SensingAnswer
   0.2676  robot    hears of call 4: its end
   0.2682  robot    performs task actions 21 to 26
   0.3294  robot    performs sensing action 0 of step 27
   0.3304  robot    asks cloud-1, call 5
   0.3334  robot    hears of call 5: TaskAnswer
   0.3334  robot    performs task actions 27 to 29
   0.3634  robot    hears of call 5: SensingAnswer
   0.3634  robot    hears of call 5: its end
   0.3640  robot    performs task actions 30 to 35
   0.4252  robot    performs sensing action 2 of step 36
   0.4262  robot    unexplained trial=0 step=36 sensing_action=2 deviations=41.5642 reason=more than 8 standard deviations from every particle
   0.4262  robot    asks cloud-1, call 6
   0.4292  robot    hears of call 6: TaskAnswer
   0.4292  robot    performs task actions 36 to 38
   0.4592  robot    hears of call 6: SensingAnswer
   0.4592  robot    hears of call 6: its end
   0.4598  robot    performs task action 39
   0.4700  robot    ends trial 0 after 40 steps

decided as without faults
