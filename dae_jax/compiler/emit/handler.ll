; The handler that XLA calls. A slot is {ptr code, i64 running calls, i64 last use}; names in angle brackets are numbers of its interface.

@loader = global ptr null                ; i32 (ptr slot): brings the code of a slot back, 0 where it cannot
@clock = global i64 0                    ; rises as programs are loaded

@wrong.stage = private constant <SAYS_STAGE>
@wrong.frame = private constant <SAYS_FRAME>
@no.memory = private constant <SAYS_MEMORY>
@no.code = private constant <SAYS_CODE>

define internal ptr @error(ptr %frame, ptr %message, i32 %code) {
  %asked = alloca [<CREATE_BYTES> x i8], align 8
  store i64 <CREATE_BYTES>, ptr %asked
  %extension = getelementptr i8, ptr %asked, i64 8
  store ptr null, ptr %extension
  %message.at = getelementptr i8, ptr %asked, i64 <MESSAGE>
  store ptr %message, ptr %message.at
  %code.at = getelementptr i8, ptr %asked, i64 <CODE>
  store i32 %code, ptr %code.at
  %api.at = getelementptr i8, ptr %frame, i64 <API>
  %api = load ptr, ptr %api.at
  %create.at = getelementptr i8, ptr %api, i64 <CREATE>
  %create = load ptr, ptr %create.at
  %error = call ptr %create(ptr %asked)
  ret ptr %error
}

define ptr @<HANDLE>(ptr %frame, ptr %slot) {
entry:
  %size = load i64, ptr %frame
  %fits = icmp uge i64 %size, <FRAME>
  br i1 %fits, label %look, label %small
small:
  %error.frame = call ptr @error(ptr %frame, ptr @wrong.frame, i32 <INVALID>)
  ret ptr %error.frame
look:
  %extension.at = getelementptr i8, ptr %frame, i64 <EXTENSION>
  %extension = load ptr, ptr %extension.at
  %plain = icmp eq ptr %extension, null
  br i1 %plain, label %call, label %extended
extended:
  %type.at = getelementptr i8, ptr %extension, i64 <TYPE>
  %type = load i32, ptr %type.at
  %asks = icmp eq i32 %type, <IS_METADATA>
  br i1 %asks, label %sizes, label %call
sizes:
  %extension.size = load i64, ptr %extension
  %extension.fits = icmp uge i64 %extension.size, <METADATA_EXTENSION>
  br i1 %extension.fits, label %metadata.size, label %small
metadata.size:
  %metadata.at = getelementptr i8, ptr %extension, i64 <METADATA>
  %metadata = load ptr, ptr %metadata.at
  %size.of.metadata = load i64, ptr %metadata
  %metadata.fits = icmp uge i64 %size.of.metadata, <METADATA_BYTES>
  br i1 %metadata.fits, label %answer, label %small
answer:
  %version = getelementptr i8, ptr %metadata, i64 <VERSION>
  store i64 <VERSION_BYTES>, ptr %version
  %version.extension = getelementptr i8, ptr %metadata, i64 <VERSION_EXTENSION>
  store ptr null, ptr %version.extension
  %major = getelementptr i8, ptr %metadata, i64 <VERSION_MAJOR>
  store i32 <MAJOR>, ptr %major
  %minor = getelementptr i8, ptr %metadata, i64 <VERSION_MINOR>
  store i32 <MINOR>, ptr %minor
  %traits = getelementptr i8, ptr %metadata, i64 <TRAITS>
  store i32 0, ptr %traits
  ret ptr null

call:
  %stage.at = getelementptr i8, ptr %frame, i64 <STAGE>
  %stage = load i32, ptr %stage.at
  %executes = icmp eq i32 %stage, <EXECUTE>
  br i1 %executes, label %enter, label %other
other:
  %error.stage = call ptr @error(ptr %frame, ptr @wrong.stage, i32 <INVALID>)
  ret ptr %error.stage
enter:
  ; First the call is counted, then the code is looked up; `release` does it the other way round.
  %running = getelementptr i8, ptr %slot, i64 8
  %before = atomicrmw add ptr %running, i64 1 seq_cst
  br label %again
again:
  %code = load atomic ptr, ptr %slot seq_cst, align 8
  %gone = icmp eq ptr %code, null
  br i1 %gone, label %load, label %run
load:
  %loader.now = load ptr, ptr @loader
  %loaded = call i32 %loader.now(ptr %slot)
  %is.loaded = icmp ne i32 %loaded, 0
  br i1 %is.loaded, label %again, label %lost
lost:
  %undone = atomicrmw sub ptr %running, i64 1 seq_cst
  %error.code = call ptr @error(ptr %frame, ptr @no.code, i32 <INTERNAL>)
  ret ptr %error.code
run:
  %now = load atomic i64, ptr @clock monotonic, align 8
  %used = getelementptr i8, ptr %slot, i64 16
  store atomic i64 %now, ptr %used monotonic, align 8
  %args.at = getelementptr i8, ptr %frame, i64 <ARGS>
  %args = load ptr, ptr %args.at
  %results.at = getelementptr i8, ptr %frame, i64 <RETS>
  %results = load ptr, ptr %results.at
  %status = call i32 %code(ptr %frame, ptr %args, ptr %results)
  %after = atomicrmw sub ptr %running, i64 1 seq_cst
  %fine = icmp eq i32 %status, 0
  br i1 %fine, label %end, label %failed
failed:
  %error.memory = call ptr @error(ptr %frame, ptr @no.memory, i32 <EXHAUSTED>)
  ret ptr %error.memory
end:
  ret ptr null
}

; Takes the code out of a slot; 0 where a call is running, which keeps it.
define i32 @release(ptr %slot) {
  %code = atomicrmw xchg ptr %slot, ptr null seq_cst
  %running = getelementptr i8, ptr %slot, i64 8
  %calls = load atomic i64, ptr %running seq_cst, align 8
  %idle = icmp eq i64 %calls, 0
  br i1 %idle, label %released, label %kept
kept:
  store atomic ptr %code, ptr %slot seq_cst, align 8
  ret i32 0
released:
  ret i32 1
}

define void @fill(ptr %slot, ptr %code) {
  %now = load atomic i64, ptr @clock monotonic, align 8
  %used = getelementptr i8, ptr %slot, i64 16
  store atomic i64 %now, ptr %used monotonic, align 8
  store atomic ptr %code, ptr %slot seq_cst, align 8
  ret void
}
