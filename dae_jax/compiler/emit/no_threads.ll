; A system without the functions that threads wait for each other by: the caller does all.
define i32 @<SHARE>(ptr %frame, ptr %work, ptr %args, ptr %results, i64 %vectors) {
  %taken = alloca i64
  store i64 0, ptr %taken
  %status = call i32 %work(ptr %args, ptr %results, ptr %taken)
  ret i32 %status
}

@limit.at = global ptr null
define void @forked() {
  ret void
}
