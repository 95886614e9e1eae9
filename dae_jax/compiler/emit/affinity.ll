; How many processors the process may run on, at most `most`: those of its first thread, since XLA's keep what they began with.
declare i32 @sched_getaffinity(i32, i64, ptr)
declare i32 @getpid()
declare i64 @llvm.ctpop.i64(i64)

define internal i64 @processors(i64 %most) {
entry:
  %mask = alloca [128 x i8], align 8
  call void @llvm.memset.p0.i64(ptr %mask, i8 0, i64 128, i1 false)
  %process = call i32 @getpid()
  %error = call i32 @sched_getaffinity(i32 %process, i64 128, ptr %mask)
  %known = icmp sge i32 %error, 0
  br i1 %known, label %next, label %unknown
next:
  %k = phi i64 [ 0, %entry ], [ %k.next, %next ]
  %count = phi i64 [ 0, %entry ], [ %count.next, %next ]
  %at = getelementptr i64, ptr %mask, i64 %k
  %word = load i64, ptr %at
  %here = call i64 @llvm.ctpop.i64(i64 %word)
  %count.next = add i64 %count, %here
  %k.next = add i64 %k, 1
  %end = icmp eq i64 %k.next, 16
  br i1 %end, label %known.count, label %next
known.count:
  %allowed = call i64 @llvm.smin.i64(i64 %count.next, i64 %most)
  ret i64 %allowed
unknown:
  ret i64 %most
}

declare void @llvm.memset.p0.i64(ptr, i8, i64, i1)
