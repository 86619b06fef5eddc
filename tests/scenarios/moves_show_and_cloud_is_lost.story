# What a move shows and an observation that comes late reach the local service as well, which is
# launched when the cloud has died.
run trial=2 moves_show=true
late step=9 moves=6
crash service=cloud-1 at=0.18 down_s=0.4
----
   0.0000  cloud-1  starts, process 1
   0.0010  robot    begins trial 2 at step 0
   0.0100  robot    service_appeared service=cloud-1
   0.0100  robot    asks cloud-1, call 1
   0.0150  robot    hears of call 1: SensingAnswer
   0.0150  robot    performs sensing action 0 of step 0
   0.0150  robot    hears of call 1: its end
   0.0160  robot    asks cloud-1, call 2
   0.0190  robot    hears of call 2: TaskAnswer
   0.0190  robot    performs task action 0
   0.0190  robot    hears of call 2: its end
   0.0292  robot    asks cloud-1, call 3
   0.0322  robot    hears of call 3: TaskAnswer
   0.0322  robot    performs task action 1
   0.0322  robot    hears of call 3: its end
   0.0424  robot    asks cloud-1, call 4
   0.0454  robot    hears of call 4: TaskAnswer
   0.0454  robot    performs task action 2
   0.0454  robot    hears of call 4: its end
   0.0556  robot    asks cloud-1, call 5
   0.0586  robot    hears of call 5: TaskAnswer
   0.0586  robot    performs task action 3
   0.0586  robot    hears of call 5: its end
   0.0688  robot    asks cloud-1, call 6
   0.0718  robot    hears of call 6: TaskAnswer
   0.0718  robot    performs task action 4
   0.0718  robot    hears of call 6: its end
   0.0820  robot    asks cloud-1, call 7
   0.0850  robot    hears of call 7: TaskAnswer
   0.0850  robot    performs task action 5
   0.0850  robot    hears of call 7: its end
   0.0952  robot    asks cloud-1, call 8
   0.0982  robot    hears of call 8: TaskAnswer
   0.0982  robot    performs task action 6
   0.0982  robot    hears of call 8: its end
   0.1084  robot    asks cloud-1, call 9
   0.1114  robot    hears of call 9: TaskAnswer
   0.1114  robot    performs task action 7
   0.1114  robot    hears of call 9: its end
   0.1216  robot    asks cloud-1, call 10
   0.1246  robot    hears of call 10: TaskAnswer
   0.1246  robot    performs task action 8
   0.1246  robot    hears of call 10: its end
   0.1348  robot    asks cloud-1, call 11
   0.1398  robot    hears of call 11: SensingAnswer
   0.1398  robot    performs sensing action 0 of step 9
   0.1398  robot    hears of call 11: its end
   0.1408  robot    asks cloud-1, call 12
   0.1438  robot    hears of call 12: TaskAnswer
   0.1438  robot    performs task action 9
   0.1438  robot    hears of call 12: its end
   0.1540  robot    asks cloud-1, call 13
   0.1570  robot    hears of call 13: TaskAnswer
   0.1570  robot    performs task action 10
   0.1570  robot    hears of call 13: its end
   0.1672  robot    asks cloud-1, call 14
   0.1702  robot    hears of call 14: TaskAnswer
   0.1702  robot    performs task action 11
   0.1702  robot    hears of call 14: its end
   0.1800  cloud-1  is killed
   0.1804  robot    asks cloud-1, call 15
   0.1820  robot    service_vanished service=cloud-1
   0.1820  robot    status from=standard to=local_recovery silent_ms=1.6 reason=cloud-1 is gone
   0.1820  robot    launch service=local
   0.1820  local    is launched
   0.1820  robot    holding step=12 reason=cloud-1: is not there; local: is being launched
   0.1820  robot    hears of call 15: its end
   0.3320  local    starts, process 1
   0.3420  robot    launched launch_ms=160
   0.3420  robot    restore service=local step=12 bytes=1578
   0.3420  robot    retry service=local step=12 attempt=2 waited_ms=161.6
   0.3420  robot    asks local, call 16
   0.3432  robot    hears of call 16: TaskAnswer
   0.3432  robot    restored service=local step=12 restore_ms=1.2
   0.3432  robot    resumed held_ms=161.2
   0.3432  robot    performs task action 12
   0.3432  robot    hears of call 16: its end
   0.3534  robot    asks local, call 17
   0.3546  robot    hears of call 17: TaskAnswer
   0.3546  robot    performs task action 13
   0.3546  robot    hears of call 17: its end
   0.3648  robot    asks local, call 18
   0.3660  robot    hears of call 18: TaskAnswer
   0.3660  robot    performs task action 14
   0.3660  robot    hears of call 18: its end
   0.3662  robot    is shown what was sensed in step 9
   0.3762  robot    asks local, call 19
   0.3774  robot    hears of call 19: TaskAnswer
   0.3774  robot    performs task action 15
   0.3774  robot    hears of call 19: its end
   0.3876  robot    asks local, call 20
   0.3888  robot    hears of call 20: TaskAnswer
   0.3888  robot    performs task action 16
   0.3888  robot    hears of call 20: its end
   0.3990  robot    asks local, call 21
   0.4002  robot    hears of call 21: TaskAnswer
   0.4002  robot    performs task action 17
   0.4002  robot    hears of call 21: its end
   0.4104  robot    asks local, call 22
   0.4136  robot    hears of call 22: SensingAnswer
   0.4136  robot    performs sensing action 0 of step 18
   0.4136  robot    hears of call 22: its end
   0.4146  robot    asks local, call 23
   0.4158  robot    hears of call 23: TaskAnswer
   0.4158  robot    performs task action 18
   0.4158  robot    hears of call 23: its end
   0.4260  robot    asks local, call 24
   0.4272  robot    hears of call 24: TaskAnswer
   0.4272  robot    performs task action 19
   0.4272  robot    hears of call 24: its end
   0.4374  robot    asks local, call 25
   0.4386  robot    hears of call 25: TaskAnswer
   0.4386  robot    performs task action 20
   0.4386  robot    hears of call 25: its end
   0.4488  robot    asks local, call 26
   0.4500  robot    hears of call 26: TaskAnswer
   0.4500  robot    performs task action 21
   0.4500  robot    hears of call 26: its end
   0.4602  robot    asks local, call 27
   0.4614  robot    hears of call 27: TaskAnswer
   0.4614  robot    performs task action 22
   0.4614  robot    hears of call 27: its end
   0.4716  robot    asks local, call 28
   0.4728  robot    hears of call 28: TaskAnswer
   0.4728  robot    performs task action 23
   0.4728  robot    hears of call 28: its end
   0.4830  robot    asks local, call 29
   0.4842  robot    hears of call 29: TaskAnswer
   0.4842  robot    performs task action 24
   0.4842  robot    hears of call 29: its end
   0.4944  robot    asks local, call 30
   0.4956  robot    hears of call 30: TaskAnswer
   0.4956  robot    performs task action 25
   0.4956  robot    hears of call 30: its end
   0.5058  robot    asks local, call 31
   0.5070  robot    hears of call 31: TaskAnswer
   0.5070  robot    performs task action 26
   0.5070  robot    hears of call 31: its end
   0.5172  robot    asks local, call 32
   0.5204  robot    hears of call 32: SensingAnswer
   0.5204  robot    performs sensing action 0 of step 27
   0.5204  robot    hears of call 32: its end
   0.5214  robot    asks local, call 33
   0.5226  robot    hears of call 33: TaskAnswer
   0.5226  robot    performs task action 27
   0.5226  robot    hears of call 33: its end
   0.5328  robot    asks local, call 34
   0.5340  robot    hears of call 34: TaskAnswer
   0.5340  robot    performs task action 28
   0.5340  robot    hears of call 34: its end
   0.5442  robot    asks local, call 35
   0.5454  robot    hears of call 35: TaskAnswer
   0.5454  robot    performs task action 29
   0.5454  robot    hears of call 35: its end
   0.5556  robot    asks local, call 36
   0.5568  robot    hears of call 36: TaskAnswer
   0.5568  robot    performs task action 30
   0.5568  robot    hears of call 36: its end
   0.5670  robot    asks local, call 37
   0.5682  robot    hears of call 37: TaskAnswer
   0.5682  robot    performs task action 31
   0.5682  robot    hears of call 37: its end
   0.5784  robot    asks local, call 38
   0.5796  robot    hears of call 38: TaskAnswer
   0.5796  robot    performs task action 32
   0.5796  robot    hears of call 38: its end
   0.5800  cloud-1  starts, process 2
   0.5898  robot    asks local, call 39
   0.5900  robot    service_appeared service=cloud-1
   0.5900  robot    restore service=cloud-1 step=33 bytes=1578
   0.5900  robot    asks cloud-1, call 40
   0.5910  robot    hears of call 39: TaskAnswer
   0.5910  robot    performs task action 33
   0.5910  robot    hears of call 39: its end
   0.5930  robot    hears of call 40: TaskAnswer
   0.5930  robot    restored service=cloud-1 step=33 restore_ms=3
   0.5930  robot    status from=local_recovery to=keep_alive outage_ms=411 reason=cloud-1 has answered
   0.5930  robot    hears of call 40: its end
   0.6012  robot    asks cloud-1, call 41
   0.6042  robot    hears of call 41: TaskAnswer
   0.6042  robot    performs task action 34
   0.6042  robot    hears of call 41: its end
   0.6144  robot    asks cloud-1, call 42
   0.6174  robot    hears of call 42: TaskAnswer
   0.6174  robot    performs task action 35
   0.6174  robot    hears of call 42: its end
   0.6276  robot    asks cloud-1, call 43
   0.6326  robot    hears of call 43: SensingAnswer
   0.6326  robot    performs sensing action 2 of step 36
   0.6326  robot    hears of call 43: its end
   0.6336  robot    unexplained trial=2 step=36 sensing_action=2 deviations=31.9204 reason=more than 8 standard deviations from every particle
   0.6336  robot    asks cloud-1, call 44
   0.6366  robot    hears of call 44: TaskAnswer
   0.6366  robot    performs task action 36
   0.6366  robot    hears of call 44: its end
   0.6468  robot    asks cloud-1, call 45
   0.6498  robot    hears of call 45: TaskAnswer
   0.6498  robot    performs task action 37
   0.6498  robot    hears of call 45: its end
   0.6600  robot    asks cloud-1, call 46
   0.6630  robot    hears of call 46: TaskAnswer
   0.6630  robot    performs task action 38
   0.6630  robot    hears of call 46: its end
   0.6732  robot    asks cloud-1, call 47
   0.6762  robot    hears of call 47: TaskAnswer
   0.6762  robot    performs task action 39
   0.6762  robot    hears of call 47: its end
   0.6864  robot    ends trial 2 after 40 steps

decided as without faults
