# The robot's process is killed after its body has moved and before it could note that. The next
# process asks the robot's body, which has moved, and does not perform the action again.
run
kill_robot boundary=18
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
   0.0292  robot    performs task actions 1 to 6
   0.0904  robot    is killed
   0.2904  robot    is started again
   0.2914  robot    begins trial 0 at step 6
   0.2914  robot    resumed_trial trial=0 step=6
   0.2914  robot    performed_unseen trial=0 step=6
   0.3004  robot    service_appeared service=cloud-1
   0.3004  robot    restore service=cloud-1 step=7 bytes=1575
   0.3004  robot    asks cloud-1, call 1
   0.3034  robot    hears of call 1: TaskAnswer
   0.3034  robot    restored service=cloud-1 step=7 restore_ms=3
   0.3034  robot    performs task action 7
   0.3034  robot    hears of call 1: SensingAnswer
   0.3034  robot    hears of call 1: its end
   0.3136  robot    performs task action 8
   0.3238  robot    performs sensing action 0 of step 9
   0.3248  robot    asks cloud-1, call 2
   0.3278  robot    hears of call 2: TaskAnswer
   0.3278  robot    performs task action 9
   0.3308  robot    hears of call 2: SensingAnswer
   0.3308  robot    hears of call 2: its end
   0.3380  robot    performs task actions 10 to 17
   0.4196  robot    performs sensing action 0 of step 18
   0.4206  robot    asks cloud-1, call 3
   0.4236  robot    hears of call 3: TaskAnswer
   0.4236  robot    performs task action 18
   0.4266  robot    hears of call 3: SensingAnswer
   0.4266  robot    hears of call 3: its end
   0.4338  robot    performs task actions 19 to 26
   0.5154  robot    performs sensing action 0 of step 27
   0.5164  robot    asks cloud-1, call 4
   0.5194  robot    hears of call 4: TaskAnswer
   0.5194  robot    performs task action 27
   0.5224  robot    hears of call 4: SensingAnswer
   0.5224  robot    hears of call 4: its end
   0.5296  robot    performs task actions 28 to 35
   0.6112  robot    performs sensing action 2 of step 36
   0.6122  robot    unexplained trial=0 step=36 sensing_action=2 deviations=41.5642 reason=more than 8 standard deviations from every particle
   0.6122  robot    asks cloud-1, call 5
   0.6152  robot    hears of call 5: TaskAnswer
   0.6152  robot    performs task action 36
   0.6182  robot    hears of call 5: SensingAnswer
   0.6182  robot    hears of call 5: its end
   0.6254  robot    performs task actions 37 to 39
   0.6560  robot    ends trial 0 after 40 steps

decided as without faults
