# A power cut takes the last two appends of the journal with it; the body says that it has done more
# than the journal knows, so nobody knows what, and the robot holds still.
run
kill_robot boundary=30 power_cut=true lost_appends=2
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
   0.0292  robot    performs task actions 1 to 8
   0.1108  robot    performs sensing action 0 of step 9
   0.1118  robot    asks cloud-1, call 3
   0.1148  robot    hears of call 3: TaskAnswer
   0.1148  robot    performs task action 9
   0.1178  robot    hears of call 3: SensingAnswer
   0.1178  robot    hears of call 3: its end
   0.1250  robot    performs task action 10
   0.1352  robot    is killed by a power cut
   0.3352  robot    is started again
   0.3362  robot    begins trial 0 at step 9
   0.3362  robot    resumed_trial trial=0 step=9

the robot holds still: trial 0, step 9: the environment says that 11 task actions were performed in this trial, the journal has 9; they do not belong together, so nothing is performed
