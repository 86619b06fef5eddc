# The cloud dies while it computes what the robot waits for. The local service is launched, is handed
# the state and goes on.
run sensing_s=0.03
crash service=cloud-1 at=0.03 down_s=3600
----
   0.0000  cloud-1  starts, process 1
   0.0010  robot    begins trial 0 at step 0
   0.0100  robot    service_appeared service=cloud-1
   0.0100  robot    asks cloud-1, call 1
   0.0300  cloud-1  is killed
   0.0320  robot    service_vanished service=cloud-1
   0.0320  robot    status from=standard to=local_recovery silent_ms=22 reason=cloud-1 is gone
   0.0320  robot    launch service=local
   0.0320  local    is launched
   0.0320  robot    holding step=0 reason=cloud-1: is not there; local: is being launched
   0.0320  robot    hears of call 1: its end
   0.1820  local    starts, process 1
   0.1920  robot    launched launch_ms=160
   0.1920  robot    retry service=local step=0 attempt=2 waited_ms=191
   0.1920  robot    asks local, call 2
   0.2222  robot    hears of call 2: SensingAnswer
   0.2222  robot    resumed held_ms=190.2
   0.2222  robot    performs sensing action 0 of step 0
   0.2222  robot    hears of call 2: its end
   0.2232  robot    asks local, call 3
   0.2244  robot    hears of call 3: TaskAnswer
   0.2244  robot    performs task actions 0 to 2
   0.2544  robot    hears of call 3: SensingAnswer
   0.2544  robot    hears of call 3: its end
   0.2550  robot    performs task actions 3 to 8
   0.3162  robot    performs sensing action 0 of step 9
   0.3172  robot    asks local, call 4
   0.3184  robot    hears of call 4: TaskAnswer
   0.3184  robot    performs task actions 9 to 11
   0.3484  robot    hears of call 4: SensingAnswer
   0.3484  robot    hears of call 4: its end
   0.3490  robot    performs task actions 12 to 17
   0.4102  robot    performs sensing action 0 of step 18
   0.4112  robot    asks local, call 5
   0.4124  robot    hears of call 5: TaskAnswer
   0.4124  robot    performs task actions 18 to 20
   0.4424  robot    hears of call 5: SensingAnswer
   0.4424  robot    hears of call 5: its end
   0.4430  robot    performs task actions 21 to 26
   0.5042  robot    performs sensing action 0 of step 27
   0.5052  robot    asks local, call 6
   0.5064  robot    hears of call 6: TaskAnswer
   0.5064  robot    performs task actions 27 to 29
   0.5364  robot    hears of call 6: SensingAnswer
   0.5364  robot    hears of call 6: its end
   0.5370  robot    performs task actions 30 to 35
   0.5982  robot    performs sensing action 2 of step 36
   0.5992  robot    unexplained trial=0 step=36 sensing_action=2 deviations=41.5642 reason=more than 8 standard deviations from every particle
   0.5992  robot    asks local, call 7
   0.6004  robot    hears of call 7: TaskAnswer
   0.6004  robot    performs task actions 36 to 38
   0.6304  robot    hears of call 7: SensingAnswer
   0.6304  robot    hears of call 7: its end
   0.6310  robot    performs task action 39
   0.6412  robot    ends trial 0 after 40 steps

decided as without faults
