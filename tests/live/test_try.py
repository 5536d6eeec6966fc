import time

def test_complete(bench):
    t=time.monotonic()
    s = bench.session(whisks=8)
    t1=time.monotonic(); 
    s.says("armed")
    t2=time.monotonic()
    try:
        assert s.code()==0, s.said()
        print(s.said(), s.report(), t1-t, t2-t1,time.monotonic()-t2)
        k=s.kept(); m=bench.moment(); print(k.lost(m), k.names(), len(k.samples), bench.arm.state(), bench.head.state())
    finally: s.end()
def test_complete2(bench):
    test_complete(bench)
