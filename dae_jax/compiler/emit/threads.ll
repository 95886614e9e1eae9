; The work of a batch: `work(args, results, taken)` takes vectors from the counter until there are none.
;
; The block that the threads of one batch share, on the heap until the last of them lets it go:
;   0 i64 holders · 8 i64 working helpers, and CLOSED once the caller is done · 16 work · 24 args · 32 results
;   128 i64 taken, on a cache line of its own · 192 mutex · 256 condition

@limit.at = global ptr null              ; the address of the largest number of threads
@busy = global i64 0                     ; threads that work or are about to, of all batches

declare ptr @malloc(i64)
declare void @free(ptr)
declare i32 @pthread_mutex_init(ptr, ptr)
declare i32 @pthread_mutex_lock(ptr)
declare i32 @pthread_mutex_unlock(ptr)
declare i32 @pthread_mutex_destroy(ptr)
declare i32 @pthread_cond_init(ptr, ptr)
declare i32 @pthread_cond_wait(ptr, ptr)
declare i32 @pthread_cond_signal(ptr)
declare i32 @pthread_cond_destroy(ptr)

define i32 @<SHARE>(ptr %frame, ptr %work, ptr %args, ptr %results, i64 %vectors) {
entry:
  %caller = atomicrmw add ptr @busy, i64 1 monotonic
  %few = icmp slt i64 %vectors, <VECTORS>
  br i1 %few, label %alone, label %count
count:
  %limit = load ptr, ptr @limit.at
  %most = load atomic i64, ptr %limit monotonic, align 8
  %single = icmp sle i64 %most, 1
  br i1 %single, label %alone, label %look
look:
  %processors = call i64 @processors(i64 %most)
  %free = sub i64 %processors, %caller
  %of.use = call i64 @llvm.smin.i64(i64 %free, i64 %vectors)
  %helpers = sub i64 %of.use, 1
  %none = icmp slt i64 %helpers, 1
  br i1 %none, label %alone, label %prepare
prepare:
  %block = call ptr @malloc(i64 384)
  %refused = icmp eq ptr %block, null
  br i1 %refused, label %alone, label %share

alone:
  %own = alloca i64
  store i64 0, ptr %own
  %status.alone = call i32 %work(ptr %args, ptr %results, ptr %own)
  %left.alone = atomicrmw sub ptr @busy, i64 1 monotonic
  ret i32 %status.alone

share:
  %holders = add i64 %helpers, 1
  store i64 %holders, ptr %block
  %state = getelementptr i8, ptr %block, i64 8
  store i64 0, ptr %state
  %work.at = getelementptr i8, ptr %block, i64 16
  store ptr %work, ptr %work.at
  %args.at = getelementptr i8, ptr %block, i64 24
  store ptr %args, ptr %args.at
  %results.at = getelementptr i8, ptr %block, i64 32
  store ptr %results, ptr %results.at
  %taken = getelementptr i8, ptr %block, i64 128
  store i64 0, ptr %taken
  %mutex = getelementptr i8, ptr %block, i64 192
  %mutex.made = call i32 @pthread_mutex_init(ptr %mutex, ptr null)
  %condition = getelementptr i8, ptr %block, i64 256
  %condition.made = call i32 @pthread_cond_init(ptr %condition, ptr null)
  %asked.for = atomicrmw add ptr @busy, i64 %helpers monotonic
  %task = alloca [<SCHEDULE_BYTES> x i8], align 8
  store i64 <SCHEDULE_BYTES>, ptr %task
  %task.extension = getelementptr i8, ptr %task, i64 8
  store ptr null, ptr %task.extension
  %ctx.at = getelementptr i8, ptr %frame, i64 <CTX>
  %ctx = load ptr, ptr %ctx.at
  %task.ctx = getelementptr i8, ptr %task, i64 <SCHEDULE_CTX>
  store ptr %ctx, ptr %task.ctx
  %task.fn = getelementptr i8, ptr %task, i64 <TASK>
  store ptr @help, ptr %task.fn
  %task.data = getelementptr i8, ptr %task, i64 <DATA>
  store ptr %block, ptr %task.data
  %api.at = getelementptr i8, ptr %frame, i64 <API>
  %api = load ptr, ptr %api.at
  %schedule.at = getelementptr i8, ptr %api, i64 <SCHEDULE>
  %schedule = load ptr, ptr %schedule.at
  br label %next
next:
  %k = phi i64 [ 0, %share ], [ %k.next, %scheduled ]
  %error = call ptr %schedule(ptr %task)
  %accepted = icmp eq ptr %error, null
  br i1 %accepted, label %scheduled, label %no.pool
scheduled:
  %k.next = add i64 %k, 1
  %enough = icmp eq i64 %k.next, %helpers
  br i1 %enough, label %compute, label %next
no.pool:
  %destroyed = alloca [<DESTROY_BYTES> x i8], align 8
  store i64 <DESTROY_BYTES>, ptr %destroyed
  %destroyed.extension = getelementptr i8, ptr %destroyed, i64 8
  store ptr null, ptr %destroyed.extension
  %destroyed.error = getelementptr i8, ptr %destroyed, i64 <ERROR>
  store ptr %error, ptr %destroyed.error
  %destroy.at = getelementptr i8, ptr %api, i64 <DESTROY>
  %destroy = load ptr, ptr %destroy.at
  call void %destroy(ptr %destroyed)
  %missing = sub i64 %helpers, %k
  %let.go = atomicrmw sub ptr %block, i64 %missing acq_rel
  %fewer = atomicrmw sub ptr @busy, i64 %missing monotonic
  br label %compute

compute:
  %status = call i32 %work(ptr %args, ptr %results, ptr %taken)
  %working = atomicrmw or ptr %state, i64 <CLOSED> acq_rel
  %finished = icmp eq i64 %working, 0
  br i1 %finished, label %leave, label %lock
lock:
  %locked = call i32 @pthread_mutex_lock(ptr %mutex)
  br label %watch
watch:
  %seen = load atomic i64, ptr %state acquire, align 8
  %done = icmp eq i64 %seen, <CLOSED>
  br i1 %done, label %unlock, label %wait
wait:
  %woken = call i32 @pthread_cond_wait(ptr %condition, ptr %mutex)
  br label %watch
unlock:
  %unlocked = call i32 @pthread_mutex_unlock(ptr %mutex)
  br label %leave
leave:
  call void @let_go(ptr %block)
  %left = atomicrmw sub ptr @busy, i64 1 monotonic
  ret i32 %status
}

define internal void @let_go(ptr %block) {
  %holders = atomicrmw sub ptr %block, i64 1 acq_rel
  %last = icmp eq i64 %holders, 1
  br i1 %last, label %end, label %kept
end:
  %mutex = getelementptr i8, ptr %block, i64 192
  %mutex.gone = call i32 @pthread_mutex_destroy(ptr %mutex)
  %condition = getelementptr i8, ptr %block, i64 256
  %condition.gone = call i32 @pthread_cond_destroy(ptr %condition)
  call void @free(ptr %block)
  ret void
kept:
  ret void
}

; What another thread does: a part of the work, unless the caller is done with it already.
define internal void @help(ptr %block) {
entry:
  %state = getelementptr i8, ptr %block, i64 8
  %first = load atomic i64, ptr %state acquire, align 8
  br label %ask
ask:
  %old = phi i64 [ %first, %entry ], [ %found, %enter ]
  %is.closed = icmp uge i64 %old, <CLOSED>
  br i1 %is.closed, label %leave, label %enter
enter:
  %new = add i64 %old, 1
  %pair = cmpxchg ptr %state, i64 %old, i64 %new acq_rel acquire
  %found = extractvalue { i64, i1 } %pair, 0
  %entered = extractvalue { i64, i1 } %pair, 1
  br i1 %entered, label %compute, label %ask
compute:
  %work.at = getelementptr i8, ptr %block, i64 16
  %work = load ptr, ptr %work.at
  %args.at = getelementptr i8, ptr %block, i64 24
  %args = load ptr, ptr %args.at
  %results.at = getelementptr i8, ptr %block, i64 32
  %results = load ptr, ptr %results.at
  %taken = getelementptr i8, ptr %block, i64 128
  ; Where it has no memory the caller does the whole work, or says so.
  %status = call i32 %work(ptr %args, ptr %results, ptr %taken)
  %mutex = getelementptr i8, ptr %block, i64 192
  %locked = call i32 @pthread_mutex_lock(ptr %mutex)
  %count = atomicrmw sub ptr %state, i64 1 acq_rel
  %last = icmp eq i64 %count, <LAST>
  br i1 %last, label %signal, label %unlock
signal:
  %condition = getelementptr i8, ptr %block, i64 256
  %signalled = call i32 @pthread_cond_signal(ptr %condition)
  br label %unlock
unlock:
  %unlocked = call i32 @pthread_mutex_unlock(ptr %mutex)
  br label %leave
leave:
  %left = atomicrmw sub ptr @busy, i64 1 monotonic
  call void @let_go(ptr %block)
  ret void
}

; In the child of a fork there is no pool, and no other thread.
define void @forked() {
  store i64 0, ptr @busy
  ret void
}

declare i64 @llvm.smin.i64(i64, i64)
